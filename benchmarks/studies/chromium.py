"""A headless Chromium, driven over its debugging pipe: JSON between NUL bytes, no library."""

import base64
import itertools
import json
import os
import selectors
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from eitskin.errors import ConfigurationError, EitskinError

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
FLAGS = (
    "--headless=new",
    "--no-sandbox",  # which root, in a container, cannot have
    "--no-first-run",
    "--disable-background-networking",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--enable-unsafe-swiftshader",  # WebGL without a graphics card
    "--disable-gpu",
)
ANSWERS_WITHIN = 60.0  # s


class BrowserError(EitskinError):
    """The browser refused a command, or has gone."""


@dataclass(frozen=True, slots=True)
class Size:
    """Of a page in CSS pixels; a phone has touch and finer pixels."""

    width: int
    height: int
    phone: bool = False


class Browser:
    """One Chromium process.

    Attributes:
        process: the running browser.
        events: what it told unasked, as pairs of session and message.
    """

    def __init__(self, process: "subprocess.Popen[bytes]", read: int, write: int) -> None:
        """Talk to `process` through its pipes."""
        self.process = process
        self.events: list[dict[str, Any]] = []
        self._read, self._write = read, write
        self._ids = itertools.count(1)
        self._rest = bytearray()
        self._messages: list[dict[str, Any]] = []

    def ask(self, method: str, session: str | None = None, **parameters: Any) -> dict[str, Any]:
        """The answer to a command of the DevTools protocol; raises BrowserError."""
        number = next(self._ids)
        message = {"id": number, "method": method, "params": parameters}
        if session is not None:
            message["sessionId"] = session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        deadline = time.monotonic() + ANSWERS_WITHIN
        while True:
            answer = self._next(deadline)
            if answer.get("id") != number:
                self.events.append(answer)
                continue
            if "error" in answer:
                raise BrowserError(f"{method}: {answer['error']['message']}")
            result: dict[str, Any] = answer["result"]
            return result

    def open(self, url: str, size: Size) -> "Tab":
        """A new tab of that size at `url`; what it complains about is kept from its start."""
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        tab = Tab(self, session, target)
        for domain in ("Runtime", "Log", "Page"):
            self.ask(f"{domain}.enable", session)
        tab.resize(size)
        self.ask("Page.navigate", session, url=url)
        return tab

    def signal(self, number: int) -> None:
        """Send a signal to every process of the browser."""
        os.killpg(self.process.pid, number)

    def _next(self, deadline: float) -> dict[str, Any]:
        while not self._messages:
            with selectors.DefaultSelector() as selector:
                selector.register(self._read, selectors.EVENT_READ)
                ready = selector.select(max(0.0, deadline - time.monotonic()))
            data = os.read(self._read, 1 << 16) if ready else b""
            if not data:
                raise BrowserError("the browser has gone" if ready else "the browser is silent")
            *whole, rest = (self._rest + data).split(b"\0")
            self._rest = bytearray(rest)
            self._messages += [json.loads(text) for text in whole]
        return self._messages.pop(0)


@dataclass(frozen=True, slots=True)
class Tab:
    """One page in a browser."""

    browser: Browser
    session: str
    target: str

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The answer to a command about this page."""
        return self.browser.ask(method, self.session, **parameters)

    def run(self, script: str) -> Any:
        """The value of a script, awaited where it is a promise; raises BrowserError."""
        answer = self.ask(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True
        )
        if "exceptionDetails" in answer:
            details = answer["exceptionDetails"]
            raise BrowserError(details.get("exception", details).get("description", str(details)))
        return answer["result"].get("value")

    def until(self, condition: str, seconds: float = 30.0) -> None:
        """Wait until a script's value is true, asked at each picture; raises BrowserError."""
        found = self.run(
            f"new Promise((done) => {{ const end = performance.now() + {1e3 * seconds};"
            f" const look = () => {{ if ({condition}) done(true);"
            " else if (performance.now() > end) done(false);"
            " else setTimeout(look, 20); }; look(); })"
        )
        if not found:
            raise BrowserError(f"{condition} did not come true within {seconds:g} s")

    def resize(self, size: Size) -> None:
        """Give the page another size."""
        self.ask(
            "Emulation.setDeviceMetricsOverride",
            width=size.width,
            height=size.height,
            deviceScaleFactor=2 if size.phone else 1,
            mobile=size.phone,
        )
        self.ask("Emulation.setTouchEmulationEnabled", enabled=size.phone)

    def screenshot(self, path: Path, whole: bool = False) -> None:
        """Write a PNG of what is seen, or of the whole page."""
        taken = self.ask("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(taken["data"]))

    def complaints(self) -> list[str]:
        """Errors of the console, and exceptions that nothing caught, so far."""
        found = []
        for event in self.browser.events:
            if event.get("sessionId") != self.session:
                continue
            method, said = event["method"], event["params"]
            if method == "Runtime.exceptionThrown":
                found.append(str(said["exceptionDetails"]))
            elif method == "Log.entryAdded" and said["entry"]["level"] == "error":
                found.append(f"{said['entry']['text']} {said['entry'].get('url', '')}".strip())
            elif method == "Runtime.consoleAPICalled" and said["type"] == "error":
                found.append(" ".join(str(a.get("value", a)) for a in said["args"]))
        return found

    def close(self) -> None:
        """Close the tab."""
        self.browser.ask("Target.closeTarget", targetId=self.target)


@contextmanager
def chromium(flags: Sequence[str] = ()) -> Iterator[Browser]:
    """Run a Chromium with a profile of its own; raises ConfigurationError where there is none."""
    program = next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        raise ConfigurationError(
            f"no browser found among {', '.join(NAMES)}; install Chromium, on Debian with "
            "apt-get install chromium"
        )
    to_browser, write = os.pipe()
    read, from_browser = os.pipe()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        # The pipe is expected at 3 and 4; the shell puts it there.
        ends = (to_browser, from_browser)
        shell = ("/bin/sh", "-c", f'exec "$@" 3<&{ends[0]} 4>&{ends[1]}', "sh")
        own = ("--remote-debugging-pipe", f"--user-data-dir={profile}")
        process = subprocess.Popen(  # noqa: S603
            [*shell, program, *FLAGS, *flags, *own, "about:blank"],
            pass_fds=ends,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        for end in ends:
            os.close(end)
        try:
            yield Browser(process, read, write)
        finally:
            os.close(write)
            os.close(read)
            for number in (signal.SIGCONT, signal.SIGKILL):
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, number)
            process.wait()
