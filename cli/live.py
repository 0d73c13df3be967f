"""`eitskin live`: what a board's sensor feels, as it happens, in the terminal."""

import json
import math
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.live import Live
from rich.rule import Rule
from rich.table import Table
from rich.text import Text

from eitskin.cli.options import Json, Output, Quiet, Seed, Verbose

if TYPE_CHECKING:
    from eitskin.datasets import ShardWriter
    from eitskin.hardware import Board, Counts, Estimate, Reading
    from eitskin.simulator import Frame

Model = Annotated[Path, typer.Argument(help="The trained pipeline, NAME.eitmodel.")]
BoardUri = Annotated[
    str, typer.Option("--board", help="serial:PORT, virtual: or replay:DIRECTORY.")
]
Frames = Annotated[int | None, typer.Option(min=1, help="End after so many; else at Ctrl-C.")]
Record = Annotated[
    Path | None, typer.Option(help="Also write every frame into a new dataset in this folder.")
]
EveryFrame = Annotated[
    bool,
    typer.Option("--every-frame", help="Process all frames, not only the newest."),
]

SHOWN = 0.3  # of the touch map; fainter pixels stay dark
REFRESH = 10  # per second


def command(
    model: Model,
    *,
    board: BoardUri = "virtual:",
    frames: Frames = None,
    record: Record = None,
    every_frame: EveryFrame = False,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Show what a board's sensor feels; with --json, print one JSON object per frame."""
    from eitskin.datasets import ShardWriter
    from eitskin.hardware import open_board, run_live
    from eitskin.training import Pipeline

    output = Output(as_json, quiet, verbose)
    pipeline = Pipeline.load(model)
    with ExitStack() as stack:
        writer = stack.enter_context(ShardWriter(record)) if record else None
        opened = stack.enter_context(open_board(board, **seeded(board, seed)))
        output.detail(f"{opened.uri}: firmware {opened.info.firmware}, {opened.protocol.labels}")
        session = Session(opened, output, writer)
        newest = not (every_frame or record)
        session.follow(run_live(opened, pipeline, newest=newest), frames)


def seeded(uri: str, seed: int) -> dict[str, Any]:
    """The seed is the virtual board's, unless its URI has its own."""
    return {"seed": seed} if uri.startswith("virtual:") and "seed=" not in uri else {}


@dataclass
class Session:
    """One run of the command: shows, records and sums up what comes."""

    board: "Board"
    output: Output
    writer: "ShardWriter | None" = None
    processed: int = 0
    latencies: deque[float] = field(default_factory=lambda: deque(maxlen=10_000))
    unrecorded: int = 0
    newest: "Reading | None" = None

    def follow(self, readings: Iterator["Reading"], frames: int | None) -> None:
        """Show the readings until they end, or so many frames have come, and sum up."""
        view = Live(
            get_renderable=self.view,
            console=self.output.console,
            refresh_per_second=REFRESH,
            auto_refresh=self.output.console.is_terminal,
        )
        try:
            with ExitStack() as stack:
                if not (self.output.as_json or self.output.quiet):
                    stack.enter_context(view)
                for reading in readings:
                    self.take(reading)
                    if self.processed == frames:
                        break
        finally:
            self.sum_up()

    def take(self, reading: "Reading") -> None:
        """Keep, record and print one reading."""
        self.newest = reading
        self.processed += 1
        self.latencies.append(reading.latency)
        if self.writer is not None:
            if np.isfinite(reading.frame.impedance).all():
                self.writer.append(reading.frame)
            else:
                self.unrecorded += 1
        if self.output.as_json:
            typer.echo(json.dumps(plain(reading, self.board.counts), allow_nan=False))

    def view(self) -> RenderableType:
        """The newest reading, drawn."""
        if self.newest is None:
            return "waiting for the first frame"
        return draw(self.newest, self.board.counts)

    @property
    def _unusable(self) -> int:
        return self.newest.unusable if self.newest is not None else 0

    def sum_up(self) -> None:
        """Say what came through; on stderr, so that --json stays one object per frame."""
        counts = self.board.counts
        text = f"{self.processed} frames processed, {_losses(counts, self._unusable)}"
        if self.latencies:
            half, most = np.percentile(self.latencies, (50, 99)) * 1e3
            text += f"; latency {half:.1f} ms median, {most:.1f} ms p99"
        if self.unrecorded:
            text += f"; {self.unrecorded} frames with values that are not finite left unrecorded"
        self.output.note(text)


def plain(reading: "Reading", counts: "Counts") -> dict[str, Any]:
    """A reading as plain data; null stands for what is unknown."""
    frame, estimate = reading.frame, reading.estimate
    return {
        "number": frame.number,
        "session": frame.session,
        "time": frame.time,
        "state": _state(estimate),
        "probabilities": [_known(p) for p in np.asarray(estimate.probabilities).tolist()],
        "bend_angle_deg": _known(estimate.bend_angle_deg),
        "touches": [[_known(value) for value in touch] for touch in estimate.touches],
        "problems": list(estimate.problems),
        "bad_channels": bad_channels(frame),
        "latency_ms": reading.latency * 1e3,
        "rate_hz": _known(reading.rate),
        "lost": counts.lost,
        "skipped": counts.skipped,
        "dropped": dict(counts.dropped),
    }


def bad_channels(frame: "Frame") -> dict[str, str]:
    """What is wrong with which measurement, by its label."""
    return {
        label: _status_text(int(bits))
        for label, bits in zip(frame.protocol.labels, frame.status, strict=True)
        if bits
    }


def draw(reading: "Reading", counts: "Counts") -> RenderableType:
    """One reading as a panel: numbers, touch map, health."""
    frame, estimate = reading.frame, reading.estimate
    numbers = Table.grid(padding=(0, 2))
    numbers.add_row("state", Text(_state(estimate), style="bold"))
    angle = estimate.bend_angle_deg
    numbers.add_row("bend", f"{angle:+.1f} deg" if math.isfinite(angle) else "unknown")
    places = [f"({x * 1e3:.0f}, {y * 1e3:.0f}) mm {s:.2f}" for x, y, s in estimate.touches]
    numbers.add_row("touches", ", ".join(places) or "none")
    rate = f"{reading.rate:.1f} frames/s" if math.isfinite(reading.rate) else "-"
    numbers.add_row("rate", f"{rate}, latency {reading.latency * 1e3:.1f} ms")
    numbers.add_row("losses", _losses(counts, reading.unusable))
    bad = bad_channels(frame)
    health = ", ".join(f"{label} {what}" for label, what in bad.items())
    good = f"all {len(frame.status)} good"
    numbers.add_row("channels", Text(health, style="red") if bad else good)
    if estimate.problems:
        numbers.add_row("problems", Text("; ".join(estimate.problems), style="red"))
    # Rules and no frame: the 80 columns of the map are all that a plain terminal has.
    return Group(
        numbers, Rule("touch map, y up, x right"), touch_picture(estimate.touch_map), Rule()
    )


def touch_picture(touch_map: NDArray[np.floating]) -> Text:
    """A touch map (rows, columns), 0 to 1, in half-blocks: two rows of it in one of text."""
    values = np.asarray(touch_map)[::-1]  # text runs downwards, y upwards
    if len(values) % 2:
        values = np.vstack([values, np.zeros_like(values[:1])])
    picture = Text(no_wrap=True, overflow="crop")
    for row, (upper, lower) in enumerate(zip(values[::2], values[1::2], strict=True)):
        if row:
            picture.append("\n")
        for high, low in zip(upper, lower, strict=True):
            block = " ▄▀█"[2 * int(high > SHOWN) + int(low > SHOWN)]
            strong = max(high, low) > 2 * SHOWN
            picture.append(block, style="" if block == " " else "red" if strong else "yellow")
    return picture


def _losses(counts: "Counts", unusable: int) -> str:
    dropped = ", ".join(f"{count} {reason}" for reason, count in counts.dropped.items())
    return (
        f"{counts.lost} lost, {counts.skipped} skipped, {unusable} unusable, "
        f"dropped: {dropped or 'none'}"
    )


def _state(estimate: "Estimate") -> str:
    """Name of the state, in small letters."""
    state = estimate.state
    return (state if isinstance(state, str) else state.name).lower()


def _status_text(bits: int) -> str:
    from eitskin.simulator import Status

    names = [flag.name.lower().replace("_", " ") for flag in Status if flag.name and flag & bits]
    return ", ".join(names) or f"status {bits:#04x}"


def _known(value: float) -> float | None:
    """`value`, None where it is not finite, which JSON cannot say."""
    return float(value) if math.isfinite(value) else None
