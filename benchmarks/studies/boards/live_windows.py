"""`eitskin live` as a subprocess, and rates of its loop and page over time windows."""

import json
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
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
    """

    name: str
    seconds: float
    frames: float
    updates: float | None
    latency_p50_ms: float
    latency_p99_ms: float


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
        start = time.monotonic()
        time.sleep(seconds)
        last, drawn_then = len(self.latencies), updates(tab)
        passed = time.monotonic() - start
        half, most = np.percentile(self.latencies[first:last] or [np.nan], (50, 99))
        drawn_rate = None if tab is None else (drawn_then - drawn) / passed
        return Window(name, passed, (last - first) / passed, drawn_rate, float(half), float(most))


def updates(tab: Tab | None) -> int:
    """Number of drawings with a new frame so far; 0 without a page."""
    return 0 if tab is None else int(tab.run("eitskin.updates"))


@contextmanager
def live_loop(seed: int, command: Sequence[str] = EITSKIN) -> Iterator[LiveLoop]:
    """Context of the shipped pipeline on a virtual board with its page."""
    board = f"virtual:?period={1 / RATE:.6f}&seed={seed}"
    arguments = ("live", "reference.eitmodel", "--board", board, "--page", "--page-port", "0")
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
