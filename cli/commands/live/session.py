"""A live session and its recordings; a disk that fails ends a recording, not the session."""

import json
import math
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Group, RenderableType
from rich.live import Live
from rich.rule import Rule
from rich.table import Table
from rich.text import Text

from eitskin import datasets, hardware, simulator, training
from eitskin.cli.commands.tare import board_number
from eitskin.cli.options import Output
from eitskin.errors import PartialError
from eitskin.latest import Latest

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from eitskin.cli.page.live_page import LivePage
    from eitskin.hardware.ros2.messages import McapWriter
    from eitskin.hardware.ros2.skin_node import SkinNode
    from eitskin.hardware.streams import ReadingPublisher
    from eitskin.training.pipeline.references import SessionOrder


class Recording:
    """Recording of a session's readings, as a dataset that can be replayed or as MCAP messages.

    Attributes:
        folder: folder of the dataset, or the MCAP file.
        given: number of readings so far.
        problem: reason why nothing more is written; empty while everything is.
    """

    def __init__(self, writer: "datasets.ShardWriter | McapWriter", folder: Path) -> None:
        """Write into `folder` by `writer`, which `close` closes."""
        self._writer: Any = writer
        self.folder, self._is_dataset = folder, hasattr(writer, "readable")
        self.given, self.problem, self._remedy = 0, "", ""

    @property
    def missing(self) -> int:
        """Number of frames that cannot be read back, among them frames not yet written."""
        return self.given - int(self._writer.readable) if self._is_dataset else 0

    @property
    def loss(self) -> str:
        """Missing data and the reason; empty where everything was written."""
        if not self._is_dataset:
            return self._remedy
        if not self.missing:
            return ""
        return (
            f"{self.missing} frames are not in {self.folder}: {self.problem}; those before are "
            "there and can be replayed"
        )

    def append(self, reading: "hardware.Reading") -> None:
        """Write the reading, unless that failed before."""
        self.given += 1
        if self.problem:
            return
        try:
            if self._is_dataset:
                self._writer.append(reading.frame)
            else:
                self._writer.write(reading)
        except PartialError as error:
            self._fail(error)

    def close(self) -> None:
        """Write remaining data, where possible."""
        try:
            self._writer.close()
        except PartialError as error:
            self._fail(error)

    def _fail(self, error: PartialError) -> None:
        self._remedy = self._remedy or str(error)
        # The rest of the message is the remedy for the end; the session goes on.
        self.problem = self.problem or str(error).partition(";")[0]


REFRESH = 10  # per second
CHECK_FRAMES = 16  # frames of a session's beginning that say how the sensor is
MIN_SILENCE = 1.0  # s, before what is shown is called old


@dataclass
class LiveSession:
    """Live session: shows, records and summarises readings.

    Attributes:
        pipeline: pipeline of the next frame; may be exchanged for another between two frames.
        checks: whether the sensor is checked where a session begins.
    """

    connection: "hardware.Connection"
    output: Output
    pipeline: Any = None
    checks: bool = True
    recordings: list[Recording] = field(default_factory=list)
    page: "LivePage | None" = None
    node: "SkinNode | None" = None
    publisher: "ReadingPublisher | None" = None
    order: "SessionOrder | None" = None
    clock: Callable[[], float] = time.monotonic
    processed: int = 0
    latencies: deque[float] = field(default_factory=lambda: deque(maxlen=10_000))
    newest: "hardware.Reading | None" = None
    newest_at: float = 0.0
    beginning: "list[simulator.Frame]" = field(default_factory=list)
    notes: deque[str] = field(default_factory=lambda: deque(maxlen=3))
    latest: Latest["hardware.Reading"] = field(default_factory=Latest)
    _recording: threading.Lock = field(default_factory=threading.Lock)
    _asked: queue.SimpleQueue[Callable[[], None]] = field(default_factory=queue.SimpleQueue)

    @property
    def stored_reference(self) -> "training.StoredReference | None":
        """Reference of the sensor, next to which a session need not begin flat."""
        reference: training.StoredReference | None = getattr(
            self.pipeline, "stored_reference", None
        )
        return reference

    def process(self, frame: "simulator.Frame") -> "hardware.Estimate":
        """Estimate of the session's pipeline."""
        estimate: hardware.Estimate = self.pipeline.process(frame)
        return estimate

    def follow(self, readings: Iterator["hardware.Reading"], frames: int | None) -> None:
        """Show readings until they end or `frames` of them were processed, then summarise."""
        view = Live(
            get_renderable=self.view,
            console=self.output.console,
            refresh_per_second=REFRESH,
            auto_refresh=self.output.console.is_terminal,
        )
        try:
            with ExitStack() as stack:
                if not (self.output.as_json or self.output.quiet):
                    if not self.output.console.is_terminal:  # there rich ends no line
                        stack.callback(self.output.console.line)
                    stack.enter_context(view)
                for reading in readings:
                    self.take(reading)
                    if self.processed == frames:
                        break
        finally:
            self.note_totals()

    def take(self, reading: "hardware.Reading") -> None:
        """Keep, show, record and print one reading."""
        self.notice_session(reading.frame)
        self.newest, self.newest_at = reading, self.clock()
        self.processed += 1
        self.latencies.append(reading.latency)
        for listener in (self.page, self.node, self.publisher):
            if listener is not None:
                listener.publish(reading)
        self.record(reading)
        self.latest.put(reading)
        while not self._asked.empty():
            self._asked.get()()
        if self.output.as_json:
            from eitskin.hardware.streams import reading_record

            counts = self.connection.board.counts
            typer.echo(json.dumps(reading_record(reading, counts), allow_nan=False))

    def record(self, reading: "hardware.Reading") -> None:
        """Write the reading; a recording that fails is noted and ended."""
        with self._recording:
            for recording in self.recordings:
                known_problem = recording.problem
                recording.append(reading)
                if recording.problem != known_problem:
                    self.say(f"recording stopped: {recording.problem}")

    def begin(self, recording: Recording) -> None:
        """Record from the next reading on; from any thread."""
        with self._recording:
            self.recordings.append(recording)

    def end(self, recording: Recording) -> None:
        """Write what a recording has left, and no more; from any thread."""
        with self._recording:
            self.recordings.remove(recording)
            recording.close()

    def call_between_frames(self, function: Callable[[], str]) -> "Future[str]":
        """Have a function called by the live loop, after the next reading; from any thread."""
        future: Future[str] = Future()

        def call() -> None:
            if future.set_running_or_notify_cancel():
                try:
                    future.set_result(function())
                except Exception as error:  # raised where the result is asked for
                    future.set_exception(error)

        self._asked.put(call)
        return future

    def tare(self, frames: Sequence["simulator.Frame"]) -> str:
        """Take the sensor, as it is now, for a zero of the kind that the session has; says so."""
        zero, board = (
            training.Zero.FLAT if self.stored_reference is None else self.stored_reference.zero,
            self.connection.board,
        )
        self.pipeline.tare(frames, zero, board_number(board.info), board.uri)
        text = f"zero: the sensor {zero}, mean of {len(frames)} frames"
        self.say(text)
        return text

    def notice_session(self, frame: "simulator.Frame") -> None:
        """Note the beginning of a session, and findings on the sensor there."""
        from eitskin.training.pipeline.references import SessionOrder

        self.order = self.order or SessionOrder()
        step = self.order.follow(frame)
        for problem in step.problems:
            self.say(problem)
        if step.new_session:
            zero = "the sensor must be flat and untouched now"
            if self.stored_reference is not None:
                zero = "the stored reference stays in use"
            self.say(f"session {frame.session} begins: the board has restarted, and {zero}")
            self.beginning = []
        expected = getattr(self.pipeline, "expected_magnitudes", None) if self.checks else None
        if expected is None or len(self.beginning) >= CHECK_FRAMES:
            return
        self.beginning.append(frame)
        if len(self.beginning) == CHECK_FRAMES:
            for finding in hardware.check_sensor(self.beginning, expected).findings:
                self.say(f"sensor check: {finding.message}")

    def say(self, text: str) -> None:
        """Show a note next to the live view, or on stderr where there is no view."""
        if self.output.console.is_terminal and not (self.output.as_json or self.output.quiet):
            self.notes.append(text)
        else:
            self.output.note(text)

    def silence(self) -> str:
        """Reason why the newest reading is old; empty while it is recent."""
        from eitskin.hardware.boards.board import longest_silence

        period = self.connection.board.info.period
        age = self.clock() - self.newest_at
        # A machine that is busy for a moment is no silence.
        if age < longest_silence(period, MIN_SILENCE):
            return ""
        problem = self.connection.problem
        return f"nothing for {age:.0f} s{f'; {problem}' if problem else ''}"

    def view(self) -> RenderableType:
        """Panel of the newest reading and notes."""
        notes = [Text(note, style="yellow") for note in self.notes]
        if self.newest is None:
            waiting = self.connection.problem or "waiting for the first frame"
            return Group(*notes, Text(waiting))
        return Group(*notes, draw(self.newest, self.connection.board.counts, self.silence()))

    def note_totals(self) -> None:
        """Note totals of the session: frames, losses, latency."""
        import numpy as np

        unusable = self.newest.unusable if self.newest is not None else 0
        text = f"{self.processed} frames processed, "
        text += losses(self.connection.board.counts, unusable)
        if self.latencies:
            half, most = np.percentile(self.latencies, (50, 99)) * 1e3
            text += f"; latency {half:.1f} ms median, {most:.1f} ms p99"
        if self.node is not None and self.node.refused:
            text += f"; {self.node.refused} ROS 2 messages found no room"
        self.output.note(text)


NOT_ESTIMATED = "not estimated"
MIN_DRAWN_VALUE = 0.3  # least value of the touch map that is drawn


def draw(
    reading: "hardware.Reading", counts: "hardware.Counts", silence: str = ""
) -> RenderableType:
    """Panel of a reading: numbers, touch map, health; `silence`: why no newer reading comes."""
    frame, estimate = reading.frame, reading.estimate
    numbers = Table.grid(padding=(0, 2))
    if silence:
        numbers.add_row("board", Text(silence, style="bold red"))
    if estimate is None:
        numbers.add_row("state", Text(f"unknown: {reading.problem}", style="bold red"))
    else:
        _add_estimate(numbers, estimate, stale=bool(silence))
    rate = f"{reading.rate:.1f} frames/s" if math.isfinite(reading.rate) else "-"
    numbers.add_row("rate", f"{rate}, latency {reading.latency * 1e3:.1f} ms")
    numbers.add_row("losses", losses(counts, reading.unusable))
    from eitskin.hardware.streams import bad_channels

    bad = bad_channels(frame)
    health = ", ".join(f"{label} {what}" for label, what in bad.items())
    good = f"all {len(frame.status)} good"
    numbers.add_row("channels", Text(health, style="red") if bad else good)
    if estimate is None:
        return numbers
    if estimate.problems:
        numbers.add_row("problems", Text("; ".join(estimate.problems), style="red"))
    if estimate.touch_map is None:
        return numbers
    # Rules and no frame: the 80 columns of the map are all that a plain terminal has.
    return Group(
        numbers, Rule("touch map, y up, x right"), touch_picture(estimate.touch_map), Rule()
    )


def _add_estimate(numbers: Table, estimate: "hardware.Estimate", stale: bool) -> None:
    """Add state, angle and touches, dimmed where the reading is old."""
    style = "dim" if stale else ""
    from eitskin.hardware.streams import state_name, zero_name

    state, angle, touches = state_name(estimate), estimate.bend_angle_deg, estimate.touches
    numbers.add_row("state", Text(state or NOT_ESTIMATED, style=style or "bold"))
    shown = NOT_ESTIMATED
    if angle is not None:
        shown = f"{angle:+.1f} deg" if math.isfinite(angle) else "unknown"
    numbers.add_row("bend", Text(shown, style=style))
    places = [f"({x * 1e3:.0f}, {y * 1e3:.0f}) mm {s:.2f}" for x, y, s in touches or ()]
    none = NOT_ESTIMATED if touches is None else "none"
    zero = zero_name(estimate)
    numbers.add_row("zero", zero if zero == "first frames" else f"stored reference, {zero}")
    numbers.add_row("touches", Text(", ".join(places) or none, style=style))


def touch_picture(touch_map: "NDArray[np.floating]") -> Text:
    """Touch map (rows, columns), 0 to 1, in half-blocks: two rows of pixels in a line of text."""
    import numpy as np

    values = np.asarray(touch_map)[::-1]  # text runs downwards, y upwards
    if len(values) % 2:
        values = np.vstack([values, np.zeros_like(values[:1])])
    picture = Text(no_wrap=True, overflow="crop")
    for row, (upper, lower) in enumerate(zip(values[::2], values[1::2], strict=True)):
        if row:
            picture.append("\n")
        for high, low in zip(upper, lower, strict=True):
            block = " ▄▀█"[2 * int(high > MIN_DRAWN_VALUE) + int(low > MIN_DRAWN_VALUE)]
            strong = max(high, low) > 2 * MIN_DRAWN_VALUE
            picture.append(block, style="" if block == " " else "red" if strong else "yellow")
    return picture


def losses(counts: "hardware.Counts", unusable: int) -> str:
    """Lost, skipped, unusable and dropped frames as a sentence."""
    dropped = ", ".join(f"{count} {reason}" for reason, count in counts.dropped.items())
    return (
        f"{counts.lost} lost, {counts.skipped} skipped, {unusable} unusable, "
        f"{counts.reconnections} reconnections, dropped: {dropped or 'none'}"
    )
