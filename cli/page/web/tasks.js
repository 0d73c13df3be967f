// What the session can be asked for: a new zero, the sensor check, recordings, the set-up.

const $ = (id) => document.getElementById(id);
const HEADINGS = { working: "", asking: "", done: "done", failed: "failed", cancelled: "cancelled" };

async function ask(path, body) {
  try {
    const answer = await fetch(path, {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify(body),
    });
    return await answer.json();
  } catch {
    return { error: "the page's server does not answer" };
  }
}

// Post a command; the reason where it is refused, else nothing.
export async function post(path, body) {
  return (await ask(path, body)).error || "";
}

export class Tasks {
  // `paths`: what this browser may ask for; where that is nothing, it only sees what is done.
  // `replay(name)` is called with the recording that is chosen.
  constructor(paths, place, replay) {
    this.place = place;
    this.commands = paths.length > 0;
    this.shown = "";
    $("tasks").hidden = false;
    $("asked").hidden = !this.commands;
    for (const button of $("asked").querySelectorAll("button[data-path]")) {
      button.hidden = !paths.includes(button.dataset.path);
      button.onclick = () => this.send(button.dataset.path, {});
    }
    $("record").onclick = () => this.send("/record", { record: !this.recording });
    $("replay").onclick = () => replay($("recordings").value);
    $("cancel").onclick = () => this.send("/cancel", {});
  }

  async send(path, body) {
    $("refused").textContent = await post(path, body);
  }

  // Readings of a recording; nothing where it cannot be shown.
  async readings(name) {
    $("refused").textContent = "reading the recording …";
    const { readings, error } = await ask("/replay", { name });
    $("refused").textContent = error || "";
    return readings;
  }

  show(state) {
    const shown = JSON.stringify(state);
    if (shown === this.shown) return;
    this.shown = shown;
    const { task, recording, recorded, recordings } = state;
    $("replays").hidden = !recordings.length;
    if (recordings.length !== $("recordings").length) $("recordings").replaceChildren(...recordings.map((name) => new Option(name, name)));
    this.recording = Boolean(recording);
    $("record").textContent = recording ? "Stop recording" : "Record";
    $("record").classList.toggle("on", this.recording);
    const text = recording ? `recording into ${recording.folder}: ${recording.frames} frames${recording.problem && `; ${recording.problem}`}`
      : recorded && `recorded into ${recorded}`;
    $("recorded").textContent = text;
    $("recorded").hidden = !text;
    const busy = Boolean(task) && !task.over;
    for (const button of $("asked").querySelectorAll("button[data-path]")) button.disabled = busy;
    $("cancel").hidden = !busy || !this.commands;
    $("task").hidden = !task;
    this.place(busy ? task.place : null);
    if (task) this.detail(task);
  }

  detail(task) {
    $("task").dataset.progress = task.progress;
    $("task-name").textContent = [task.name, HEADINGS[task.progress]].filter(Boolean).join(": ");
    $("task-text").textContent = task.text;
    $("task-lines").replaceChildren(...[...task.lines].reverse().map((text) => Object.assign(document.createElement("li"), { textContent: text })));
    const offered = this.commands ? task.choices : [];
    $("choices").replaceChildren(...offered.map(([answer, words], number) => {
      const button = Object.assign(document.createElement("button"), { type: "button", textContent: words });
      button.classList.toggle("first", number === 0);
      button.onclick = () => this.send("/answer", { answer });
      return button;
    }));
    $("choices").hidden = !offered.length;
  }
}
