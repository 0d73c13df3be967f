"""The live page in a real browser: updates per second, refusals, stalls, and screenshots.

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
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from eitskin.benchmarks.studies.boards.chromium import BrowserError, Size, Tab, chromium
from eitskin.benchmarks.studies.boards.live_windows import EITSKIN, RATE, Window, live_loop, updates
from eitskin.provenance import Provenance

DESKTOP, PHONE = Size(1440, 900), Size(390, 844, phone=True)
BENT = {"bend_deg": 25, "touches": []}
TOUCHED = BENT | {
    "touches": [{"x": 0.05, "y": 0.03, "force": 8}, {"x": 0.115, "y": 0.02, "force": 10}]
}


@dataclass(frozen=True, slots=True)
class Found:
    """Results of the study.

    Attributes:
        windows: in the order in which they were measured.
        refusals: answer to each attempt from a foreign page.
        back_after_s: from waking the stalled browser to its next update [s].
        stale_after_s: from unplugging the board to the page's message [s].
        complaints: errors of the page's console.
        event_bytes: size of the largest event.
        load: load average of the last minute before the study.
        provenance: where, when and with what.
    """

    windows: tuple[Window, ...]
    refusals: dict[str, str]
    back_after_s: float
    stale_after_s: float
    complaints: tuple[str, ...]
    event_bytes: int
    load: float
    provenance: Provenance


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


def run(out: Path, seed: int = 0, seconds: float = 20.0, command: Sequence[str] = EITSKIN) -> Found:
    """Run the study, with screenshots in the folder `out`."""
    load = os.getloadavg()[0]
    with live_loop(seed, command) as live, chromium() as browser, foreign_page() as elsewhere:
        time.sleep(5.0)  # the first frames wait for imports
        windows = [live.watch("idle, no browser", seconds)]
        tab = browser.open(live.url, DESKTOP)
        tab.until(f"window.eitskin && eitskin.updates > {RATE}", 30.0)
        windows.append(live.watch("idle", seconds, tab))
        pictures(tab, out, "idle")
        command_board(tab, "/scene", BENT)
        time.sleep(2.0)
        command_board(tab, "/scene", TOUCHED)
        time.sleep(2.0)
        windows.append(live.watch("bent and touched", seconds, tab))
        pictures(tab, out, "touched")
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
        command_board(tab, "/fault", {"fault": "unplug"})
        stale = _seconds_until(tab, "document.body.dataset.link !== 'live'")
        time.sleep(1.0)
        pictures(tab, out, "unplugged")
    now = Provenance.now(seed)
    return Found(tuple(windows), refusals, back, stale, tuple(complaints), largest, load, now)


def _seconds_until(tab: Tab, condition: str) -> float:
    start = time.monotonic()
    tab.until(condition)
    return time.monotonic() - start


def as_markdown(found: Found) -> str:
    """Windows and refusals as tables, other results as sentences."""
    lines = [
        "| | frames/s | page updates/s | latency p50, ms | p99, ms |",
        "|---|---|---|---|---|",
    ]
    for window in found.windows:
        updates = "" if window.updates is None else f"{window.updates:.1f}"
        lines.append(
            f"| {window.name} | {window.frames:.1f} | {updates} | "
            f"{window.latency_p50_ms:.1f} | {window.latency_p99_ms:.1f} |"
        )
    lines += ["", "| from a foreign page | came of it |", "|---|---|"]
    lines += [f"| {name} | {what} |" for name, what in found.refusals.items()]
    lines += [
        "",
        f"Browser stopped for {found.windows[3].seconds:.0f} s: its next update came "
        f"{found.back_after_s:.1f} s after it was woken. Plug pulled: the page said so after "
        f"{found.stale_after_s:.1f} s. Largest event {found.event_bytes} bytes. Console errors: "
        f"{len(found.complaints)}.",
        "",
        f"{found.provenance}; both cores of the machine shared by the browser, which renders in "
        f"software, the board and the pipeline; load average before it began {found.load:.1f}",
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("build/bench/page"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=20.0, help="of each measurement")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    found = run(given.out, given.seed, given.seconds)
    (given.out / "page.json").write_text(json.dumps(asdict(found), indent=1) + "\n")
    (given.out / "page.md").write_text(as_markdown(found))
    print(as_markdown(found))


if __name__ == "__main__":
    main()
