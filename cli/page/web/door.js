// The token of the page's address: shown to the server once, which keeps it in a cookie.

const $ = (id) => document.getElementById(id);

async function entered(token) {
  const answer = await fetch("/enter", {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify({ token }),
  });
  return answer.ok ? "" : (await answer.json()).error;
}

async function role() {
  return (await (await fetch("/access")).json()).role;
}

// What this browser may do: "viewer" or "commander". Waits for a token where one is needed.
export async function admitted() {
  const token = decodeURIComponent(location.hash.slice(1));
  // Out of the address bar, the history, and what is shared from it.
  if (token) history.replaceState(null, "", "/");
  let wrong = token && await entered(token);
  let known = await role();
  while (known === "stranger") {
    $("door-said").textContent = wrong || "";
    $("door").hidden = false;
    wrong = await entered(await typed());
    known = await role();
  }
  $("door").hidden = true;
  return known;
}

function typed() {
  return new Promise((done) => {
    $("door").onsubmit = (event) => {
      event.preventDefault();
      // A whole address may be pasted as well.
      done($("token").value.trim().replace(/^.*#/, ""));
    };
  });
}
