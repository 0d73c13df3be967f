"""The live page in a real browser: updates, delays, refusals, stalls, floods, and screenshots.

`python -m eitskin.benchmarks.studies.boards.page --out DIR` runs `eitskin live --page` on a virtual
board at 30 frames per second and opens it in a headless Chromium, which must be installed.
"""

import argparse
import functools
import http.client
import http.server
import json
import os
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from eitskin.benchmarks.results import Results, write_results
from eitskin.benchmarks.studies.boards.chromium import BrowserError, Size, Tab, chromium
from eitskin.benchmarks.studies.boards.live_windows import EITSKIN, RATE, live_loop, updates
from eitskin.benchmarks.studies.boards.page_report import Found, as_markdown, figures_of
from eitskin.benchmarks.studies.boards.trickling import Held, trickle
from eitskin.provenance import Provenance

DESKTOP, PHONE = Size(1440, 900), Size(390, 844, phone=True)
TRIALS = 60
COMMAND = "python -m eitskin.benchmarks.studies.boards.page"
BENT = {"bend_deg": 25, "touches": []}
TOUCHED = BENT | {
    "touches": [{"x": 0.05, "y": 0.03, "force": 8}, {"x": 0.115, "y": 0.02, "force": 10}]
}


@contextmanager
def foreign_page() -> Iterator[str]:
    """Context of an empty page of another origin; yields its address."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "index.html").write_text("<!doctype html><title>elsewhere</title>")
        handler = functools.partial(_Silent, directory=folder)
        with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            yield f"http://127.0.0.1:{server.server_port}/"
            server.shutdown()


class _Silent(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        pass


def command_board(tab: Tab, path: str, data: dict[str, Any]) -> None:
    """Post a command from the page, as its controls do; raises BrowserError if it is refused."""
    answer = tab.run(
        f"fetch({path!r}, {{method: 'POST', headers: {{'Content-Type': 'application/json'}}, "
        f"body: {json.dumps(json.dumps(data))}}}).then((answer) => answer.text())"
    )
    if answer != '{"done":true}':
        raise BrowserError(f"{path}: {answer}")


def refused(tab: Tab, url: str) -> dict[str, str]:
    """Answers to a foreign page's attempts to read and command the page at `url`."""
    body = json.dumps(json.dumps({"bend_deg": 60}))
    attempts = {
        "fetch of the events": f"fetch('{url}events')",
        "fetch of the events without CORS": f"fetch('{url}events', {{mode: 'no-cors'}})",
        "event source": f"new Promise((done, fail) => {{ const s = new EventSource('{url}events');"
        " s.onmessage = done; s.onerror = () => { s.close(); fail(new Error('refused')); }; })",
        "command as JSON": f"fetch('{url}scene', {{method: 'POST', headers: "
        f"{{'Content-Type': 'application/json'}}, body: {body}}})",
        "command as text without CORS": f"fetch('{url}scene', {{method: 'POST', "
        f"mode: 'no-cors', headers: {{'Content-Type': 'text/plain'}}, body: {body}}})",
    }
    said = "(answer) => answer.type === 'opaque' ? 'nothing to be read' : 'read'"
    found = {
        name: str(tab.run(f"{script}.then({said}).catch((error) => `${{error}}`)"))
        for name, script in attempts.items()
    }
    client = http.client.HTTPConnection(url.removeprefix("http://").rstrip("/"), timeout=10)
    client.request("GET", "/events", headers={"Origin": "http://elsewhere.example"})
    found["status of a foreign Origin"] = str(client.getresponse().status)
    client.close()
    return found


def from_command_to_drawing(tab: Tab) -> float:
    """Time from a command of another bend to the page's drawing of its truth [ms].

    It does not depend on any clock but the browser's.
    """
    return float(
        tab.run(
            """new Promise((done) => {
            const shown = document.getElementById("true-angle"), begun = performance.now();
            const bend = shown.textContent.startsWith("true +20") ? 10 : 20;
            const look = () => shown.textContent.startsWith(`true +${bend}`)
              ? done(performance.now() - begun) : requestAnimationFrame(look);
            fetch("/scene", { method: "POST", headers: { "Content-Type": "application/json" },
              body: JSON.stringify({ bend_deg: bend, touches: [] }) });
            look();
            })"""
        )
    )


def loaded_bytes(tab: Tab, url: str) -> int:
    """Bytes that a browser loads: all files with their heads, and the event on the sensor."""
    files = tab.run(
        "performance.getEntriesByType('navigation').concat(performance.getEntriesByType("
        "'resource')).map((each) => each.transferSize).reduce((sum, size) => sum + size, 0)"
    )
    client = http.client.HTTPConnection(url.removeprefix("http://").rstrip("/"), timeout=10)
    client.request("GET", "/events")
    stream = client.getresponse()
    while not (line := stream.readline()).startswith(b"data: "):
        pass
    client.close()
    return int(files) + len(line)


def pictures(tab: Tab, out: Path, name: str) -> None:
    """Save screenshots on a desktop, and of the whole page on a phone."""
    tab.screenshot(out / f"live-page-{name}.png")
    tab.resize(PHONE)
    height = int(
        tab.run(
            "new Promise((done) => setTimeout(() => done(document."
            "documentElement.scrollHeight), 500))"
        )
    )
    tab.resize(Size(PHONE.width, height, phone=True))
    time.sleep(1.0)
    tab.screenshot(out / f"live-page-{name}-phone.png")
    tab.resize(DESKTOP)
    time.sleep(1.0)


def set_up_pictures(out: Path, seed: int, command: Sequence[str] = EITSKIN) -> None:
    """Save screenshots of a set-up that asks for a press, of a board that cannot move itself."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        link = Path(folder) / "board"
        serve = [*command, "board", "--link", str(link), "--period", f"{1 / RATE:.6f}"]
        board = subprocess.Popen(  # noqa: S603
            [*serve, "--seed", str(seed), "-q"], stdout=subprocess.DEVNULL
        )
        stack.callback(board.wait)
        stack.callback(board.send_signal, signal.SIGINT)
        while not link.exists():
            time.sleep(0.1)
        options = ("--page-folder", folder)
        live = stack.enter_context(live_loop(seed, command, f"serial:{link}", *options))
        tab = stack.enter_context(chromium()).open(live.url, DESKTOP)
        tab.until(f"window.eitskin && eitskin.updates > {RATE}", 60.0)
        tab.run("document.querySelector('[data-path=\"/setup\"]').click()")
        # Check, zero and angles are skipped; of the presses the flat sensor is taken first.
        for question, answer in (
            ("check:", 1), ("zero:", 1), ("angles:", 1), ("presses:", 0), ("lay it flat", 0)
        ):  # fmt: skip
            asked = f"document.getElementById('task-text').textContent.startsWith({question!r})"
            tab.until(f"{asked} && document.querySelectorAll('#choices button').length", 60.0)
            tab.run(f"document.querySelectorAll('#choices button')[{answer}].click()")
        tab.until("document.getElementById('task-text').textContent.startsWith('press at 1')")
        time.sleep(1.0)
        pictures(tab, out, "setup")


def run(out: Path, seed: int = 0, seconds: float = 20.0, command: Sequence[str] = EITSKIN) -> Found:
    """Run the study, with screenshots in the folder `out`."""
    load = os.getloadavg()[0]
    with live_loop(seed, command) as live, chromium() as browser, foreign_page() as elsewhere:
        time.sleep(5.0)  # the first frames wait for imports
        windows = [live.watch("idle, no browser", seconds)]
        held = [Held.by(live.process.pid)]
        tab = browser.open(live.url, DESKTOP)
        tab.until(f"window.eitskin && eitskin.updates > {RATE}", 30.0)
        loaded = loaded_bytes(tab, live.url)
        windows.append(live.watch("idle", seconds, tab))
        held.append(Held.by(live.process.pid))
        pictures(tab, out, "idle")
        command_board(tab, "/scene", BENT)
        time.sleep(2.0)
        command_board(tab, "/scene", TOUCHED)
        time.sleep(2.0)
        windows.append(live.watch("bent and touched", seconds, tab))
        pictures(tab, out, "touched")
        stimulus = tuple(from_command_to_drawing(tab) for _ in range(TRIALS))
        command_board(tab, "/scene", TOUCHED)
        complaints = browser.console_errors(live.url)
        foreign = browser.open(elsewhere, DESKTOP)
        foreign.until("document.readyState === 'complete' && location.protocol === 'http:'")
        refusals = refused(foreign, live.url)
        refusals["the board's bend after it"] = str(
            tab.run("document.getElementById('bend').value")
        )
        foreign.close()
        complaints += browser.console_errors(live.url, network=False)
        browser.signal(signal.SIGSTOP)
        windows.append(live.watch("bent and touched, browser stopped", seconds))
        browser.signal(signal.SIGCONT)
        back = _seconds_until(
            tab, f"eitskin.updates > {updates(tab)} && document.body.dataset.link === 'live'"
        )
        windows.append(live.watch("bent and touched, browser awake again", seconds, tab))
        complaints += browser.console_errors(live.url)
        largest = int(tab.run("eitskin.largest"))
        window, most, trickling = trickle(live, tab, seconds)
        windows.append(window)
        held.append(most)
        command_board(tab, "/fault", {"fault": "unplug"})
        stale = _seconds_until(tab, "document.body.dataset.link !== 'live'")
        time.sleep(1.0)
        pictures(tab, out, "unplugged")
    now = Provenance.now(seed)
    set_up_pictures(out, seed, command)
    return Found(
        windows=tuple(windows),
        stimulus=stimulus,
        held=tuple(held),
        trickling=trickling,
        page_bytes=loaded,
        refusals=refusals,
        back_after_s=back,
        stale_after_s=stale,
        complaints=tuple(complaints),
        event_bytes=largest,
        load=load,
        provenance=now,
    )


def _seconds_until(tab: Tab, condition: str) -> float:
    start = time.monotonic()
    tab.until(condition)
    return time.monotonic() - start


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("build/bench"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=20.0, help="of each measurement")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    begun = time.monotonic()
    found = run(given.out, given.seed, given.seconds)
    seconds = time.monotonic() - begun
    write_results(
        Results(
            "page",
            f"{COMMAND} --seconds {given.seconds:g}",
            found.provenance,
            seconds,
            figures=figures_of(found),
        ),
        given.out,
    )
    print(as_markdown(found))


if __name__ == "__main__":
    main()
