"""`eitskin live` as a subprocess, and rates of its loop and page over time windows."""

import json
import math
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from eitskin.benchmarks.studies.boards.chromium import BrowserError, Tab

RATE = 30  # frames per second of the board
EITSKIN = (sys.executable, "-c", "from eitskin.cli.main import run; run()")
START_WITHIN = 120.0  # s


@dataclass(frozen=True, slots=True)
class Window:
    """Rates over some seconds of the live loop, with or without a browser.

    Attributes:
        name: conditions.
        seconds: duration.
        frames: rate of processed frames [Hz].
        updates: rate of drawings with a new frame [Hz]; None without a page.
        latency_p50_ms, latency_p99_ms: latency of the pipeline.
        drawn_p50_ms, drawn_p99_ms: from the beginning of a frame's measurement to its drawing; NaN
            without a page.
    """

    name: str
    seconds: float
    frames: float
    updates: float | None
    latency_p50_ms: float
    latency_p99_ms: float
    drawn_p50_ms: float = math.nan
    drawn_p99_ms: float = math.nan

    @classmethod
    def together(cls, parts: Sequence["Window"]) -> "Window":
        """Windows in succession as one: rates are means, percentiles the largest ones."""
        seconds = sum(part.seconds for part in parts)

        def rate(read: Callable[[Window], float | None]) -> float:
            return sum((read(part) or 0.0) * part.seconds for part in parts) / seconds

        updates = None if parts[0].updates is None else rate(lambda part: part.updates)
        percentiles = ("latency_p50_ms", "latency_p99_ms", "drawn_p50_ms", "drawn_p99_ms")
        most = {name: max(getattr(part, name) for part in parts) for name in percentiles}
        return cls(parts[0].name, seconds, rate(lambda part: part.frames), updates, **most)


class LiveLoop:
    """Subprocess `eitskin live --page --json`.

    Attributes:
        url: address of its page.
        latencies: latency of each frame so far [ms].
    """

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        """Wait for the page; raises BrowserError without one."""
        self.process, self.url = process, ""
        self.latencies: list[float] = []
        self._found = threading.Event()
        for work in (self._read_frames, self._read_notes):
            threading.Thread(target=work, daemon=True).start()
        if not self._found.wait(START_WITHIN) or not self.url:
            raise BrowserError("eitskin live served no page")

    def _read_frames(self) -> None:
        for line in self.process.stdout or ():
            self.latencies.append(json.loads(line)["latency_ms"])

    def _read_notes(self) -> None:
        for line in self.process.stderr or ():
            found = re.search(r"http://127\.0\.0\.1:\d+/", line)
            if found and not self.url:
                self.url = found[0]
                self._found.set()
        self._found.set()

    def watch(self, name: str, seconds: float, tab: Tab | None = None) -> Window:
        """Measure a window of `seconds`."""
        first, drawn = len(self.latencies), updates(tab)
        if tab is not None:
            tab.run("(eitskin.delays.length = 0)")
        start = time.monotonic()
        time.sleep(seconds)
        last, drawn_then = len(self.latencies), updates(tab)
        passed = time.monotonic() - start
        half, most = np.percentile(self.latencies[first:last] or [np.nan], (50, 99))
        drawn_rate = None if tab is None else (drawn_then - drawn) / passed
        delays = [math.nan] if tab is None else tab.run("eitskin.delays") or [math.nan]
        return Window(
            name,
            passed,
            (last - first) / passed,
            drawn_rate,
            float(half),
            float(most),
            *(float(value) for value in np.percentile(delays, (50, 99))),
        )


def updates(tab: Tab | None) -> int:
    """Number of drawings with a new frame so far; 0 without a page."""
    return 0 if tab is None else int(tab.run("eitskin.updates"))


@contextmanager
def live_loop(
    seed: int, command: Sequence[str] = EITSKIN, board: str = "", *options: str
) -> Iterator[LiveLoop]:
    """Context of the shipped pipeline with its page, on a board or a virtual one at `RATE`."""
    board = board or f"virtual:?period={1 / RATE:.6f}&seed={seed}"
    page = ("--page", "--page-port", "0", *options)
    arguments = ("live", "reference.eitmodel", "--board", board, *page)
    process = subprocess.Popen(  # noqa: S603
        [*command, *arguments, "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield LiveLoop(process)
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(20.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
