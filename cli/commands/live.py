"""`eitskin live`: live estimates of a board's sensor, in the terminal and on a page."""

import json
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer
from rich.console import Group, RenderableType
from rich.live import Live
from rich.text import Text

from eitskin.cli.commands.live_recording import FrameRecording, MessageRecording, Recording
from eitskin.cli.commands.live_ros2 import Ros2, Ros2Domain, Ros2Namespace
from eitskin.cli.commands.stored_references import (
    ReferenceFile,
    board_number,
    tell_unjudged,
    use_reference,
)
from eitskin.cli.options import (
    Json,
    MethodCode,
    Model,
    Output,
    Quiet,
    Seed,
    Verbose,
    ended_by_signals,
    one_of,
    own_method,
)
from eitskin.errors import ConfigurationError, PartialError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from eitskin.cli.page.live_page import LivePage
    from eitskin.cli.page.region import Region
    from eitskin.frame import Frame
    from eitskin.geometry.design.sensor import SensorDesign
    from eitskin.hardware.boards.board import Board
    from eitskin.hardware.boards.connection import Connection
    from eitskin.hardware.live import FramePipeline, Reading
    from eitskin.hardware.ros2.skin_node import SkinNode
    from eitskin.hardware.streams.publisher import ReadingPublisher
    from eitskin.training.adaptation.recorded_touches import RecordedTouches
    from eitskin.training.pipeline.pipeline import Pipeline
    from eitskin.training.pipeline.session_order import SessionOrder
    from eitskin.training.pipeline.stored_reference import StoredReference

BoardUri = Annotated[
    str, typer.Option("--board", help="serial:PORT, text:PORT, virtual: or replay:DIRECTORY.")
]
FrameCount = Annotated[
    int | None, typer.Option(min=1, help="Number of frames; until Ctrl-C when omitted.")
]
Record = Annotated[
    Path | None, typer.Option(help="Also write every frame into a new dataset in this folder.")
]
Mcap = Annotated[
    Path | None,
    typer.Option(help="Also write frames and estimates, as ROS 2 messages, into this .mcap file."),
]
EveryFrame = Annotated[
    bool,
    typer.Option("--every-frame", help="Process all frames, not only the newest."),
]
ShowPage = Annotated[bool, typer.Option("--page", help="Also serve a page to this machine.")]
PagePort = Annotated[
    int, typer.Option(min=0, max=65535, help="Port of the page; 0 for a free one.")
]

UdpAddress = Annotated[
    str | None,
    typer.Option("--udp", metavar="[HOST:]PORT", help="Also send every reading by UDP."),
]
WebSocketAddress = Annotated[
    str | None,
    typer.Option(
        "--websocket",
        metavar="[HOST:]PORT",
        help="Also serve readings by WebSocket; 0 for a free port.",
    ),
]
PictureMethod = Annotated[
    str | None,
    typer.Option(help="Also picture every frame by this method, such as greit, for the page."),
]

MARGIN = 0.0075  # m, shown around the positions on a sensor of unknown geometry
REFRESH = 10  # per second
CHECKED = 16  # frames of a session's beginning that say how the sensor is
SHORTEST_SILENCE = 1.0  # s, before what is shown is called old


def command(
    model: Model,
    *,
    board: BoardUri = "virtual:",
    frames: FrameCount = None,
    record: Record = None,
    mcap: Mcap = None,
    every_frame: EveryFrame = False,
    page: ShowPage = False,
    page_port: PagePort = 8940,
    udp: UdpAddress = None,
    websocket: WebSocketAddress = None,
    reference: ReferenceFile = None,
    method: MethodCode = None,
    picture: PictureMethod = None,
    ros2: Ros2 = False,
    ros2_domain: Ros2Domain = 0,
    ros2_namespace: Ros2Namespace = "eitskin",
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Show state, angle and touches of a board's sensor; with --json, one JSON object per frame.

    The sensor must be flat and untouched when a session begins: at the start, and whenever the
    board has started anew; with its stored reference it may be bent and touched. A board that goes
    away is connected to again until it is back.
    """
    from eitskin.hardware.boards.connection import Connection
    from eitskin.hardware.live import run_live
    from eitskin.hardware.opening import open_board
    from eitskin.hardware.streams.opening import open_publisher
    from eitskin.training.adaptation.opening import open_pipeline

    output = Output(as_json, quiet, verbose)
    pipeline = open_pipeline(model, own_method(method))
    tell_missing(pipeline, output)
    recordings: list[Recording] = []
    with ExitStack() as stack:
        # Asked last, when all are closed: most sessions are ended by Ctrl-C.
        stack.push(partial(_tell_losses, recordings))
        stack.enter_context(ended_by_signals())
        for each in _recordings(record, mcap):
            recordings.append(stack.enter_context(closing(each)))
        opened = stack.enter_context(open_board(board, **seeded(board, seed)))
        output.detail(f"{opened.uri}: firmware {opened.info.firmware}, {opened.protocol.labels}")
        if reference is not None:
            use_reference(pipeline, reference, opened.info, output)
        tell_unjudged(pipeline, output)
        session = LiveSession(Connection(opened), output, recordings)
        session.stored = getattr(pipeline, "stored", None)
        session.connection.tell = session.say
        layout = getattr(pipeline, "layout", None)
        # A recording was checked when it was made, and need not begin flat.
        if layout is not None and not board.startswith("replay:"):
            session.expected = layout.reference
            if session.stored is not None:
                session.expected = session.stored.magnitudes(layout.reference)
        if page:
            from eitskin.cli.page.live_page import LivePage

            session.page = stack.enter_context(
                closing(LivePage(session.connection, sheet_of(pipeline), page_port))
            )
            output.note(f"page: {session.page.url}")
        if ros2:
            from eitskin.hardware.ros2.skin_node import SkinNode

            node = SkinNode(ros2_namespace, ros2_domain, partial(session.tare, pipeline))
            session.node = stack.enter_context(node)
            output.note(f"ROS 2: topics of /{node.name} in domain {ros2_domain}")
        if udp is not None or websocket is not None:
            publisher = open_publisher(session.connection, udp, websocket)
            session.publisher = stack.enter_context(publisher)
            for address in publisher.addresses:
                output.note(f"readings: {address}")
        newest = not (every_frame or recordings)
        followed = pipeline if picture is None else _pictured(pipeline, opened, picture)
        session.follow(run_live(session.connection, followed, newest=newest), frames)


def _pictured(
    pipeline: "Pipeline | RecordedTouches", board: "Board", method: str
) -> "FramePipeline":
    """Pipeline with a picture of each frame, of the sensor that the pipeline was trained for."""
    from eitskin.cli.live_pictures import LivePictures, PicturedPipeline
    from eitskin.cli.page.region import Region
    from eitskin.training.reconstruction.reconstructor import Method

    sheet = sheet_of(pipeline)
    if isinstance(sheet, Region):
        raise ConfigurationError(
            "expected a pipeline that knows its sensor's geometry, for pictures, got one trained "
            "without; leave out --picture, or train it on a recording imported with --sensor"
        )
    name = cast("Method", one_of("--picture", method, Method))
    return PicturedPipeline(pipeline, LivePictures.of(sheet, board.protocol, name))


def tell_missing(pipeline: "Pipeline | RecordedTouches", output: Output) -> None:
    """Note what a pipeline does not estimate."""
    targets = getattr(pipeline, "targets", None)
    if targets is not None and targets.missing:
        output.note(f"this pipeline does not estimate {', '.join(targets.missing)}")


def sheet_of(pipeline: "Pipeline | RecordedTouches") -> "SensorDesign | Region":
    """Sensor of a pipeline, or the region of the positions that it was trained with.

    Raises ConfigurationError where a pipeline tells neither.
    """
    from eitskin.cli.page.region import Region
    from eitskin.training.adaptation.recorded_touches import RecordedTouches

    if not isinstance(pipeline, RecordedTouches):
        return pipeline.layout.design
    if pipeline.design is not None:
        return pipeline.design
    if pipeline.extent is None:
        raise ConfigurationError(
            "expected a pipeline that knows its sensor, for the page, got touch positions of "
            "version 0.1; leave out --page, or train them again"
        )
    return Region.of_positions(pipeline.extent, MARGIN)


def _tell_losses(recordings: Sequence[Recording], _: object, ended: object, __: object) -> None:
    """Raise PartialError for what could not be written, unless another error ended the session."""
    lost = [each.loss for each in recordings if each.loss]
    if lost and (ended is None or isinstance(ended, KeyboardInterrupt)):
        raise PartialError("; ".join(lost))


def _recordings(record: Path | None, mcap: Path | None) -> Iterator[Recording]:
    """Recordings of the session; existing files are never replaced.

    The file comes first: where it cannot be, no folder has been made.
    """
    if mcap is not None:
        from eitskin.hardware.export.mcap import McapWriter

        yield MessageRecording(McapWriter(mcap, now=time.time_ns))
    if record is not None:
        from eitskin.datasets.store.writer import ShardWriter

        yield FrameRecording(ShardWriter(record), record)


def seeded(uri: str, seed: int) -> dict[str, Any]:
    """Seed as an option of a virtual board whose URI has none."""
    return {"seed": seed} if uri.startswith("virtual:") and "seed=" not in uri else {}


@dataclass
class LiveSession:
    """Live session: shows, records and summarises readings."""

    connection: "Connection"
    output: Output
    recordings: Sequence[Recording] = ()
    page: "LivePage | None" = None
    node: "SkinNode | None" = None
    publisher: "ReadingPublisher | None" = None
    expected: "NDArray[np.float64] | None" = None
    stored: "StoredReference | None" = None
    order: "SessionOrder | None" = None
    clock: Callable[[], float] = time.monotonic
    processed: int = 0
    latencies: deque[float] = field(default_factory=lambda: deque(maxlen=10_000))
    newest: "Reading | None" = None
    newest_at: float = 0.0
    beginning: "list[Frame]" = field(default_factory=list)
    notes: deque[str] = field(default_factory=lambda: deque(maxlen=3))

    def follow(self, readings: Iterator["Reading"], frames: int | None) -> None:
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
                    stack.enter_context(view)
                for reading in readings:
                    self.take(reading)
                    if self.processed == frames:
                        break
        finally:
            self.sum_up()

    def take(self, reading: "Reading") -> None:
        """Keep, show, record and print one reading."""
        self.notice_session(reading.frame)
        self.newest, self.newest_at = reading, self.clock()
        self.processed += 1
        self.latencies.append(reading.latency)
        for listener in (self.page, self.node, self.publisher):
            if listener is not None:
                listener.publish(reading)
        self.record(reading)
        if self.output.as_json:
            from eitskin.hardware.streams.reading_record import reading_record

            counts = self.connection.board.counts
            typer.echo(json.dumps(reading_record(reading, counts), allow_nan=False))

    def record(self, reading: "Reading") -> None:
        """Write the reading; a recording that fails is noted and ended."""
        for recording in self.recordings:
            known = recording.problem
            recording.append(reading)
            if recording.problem != known:
                self.say(f"recording stopped: {recording.problem}")

    def tare(self, pipeline: "Pipeline | RecordedTouches", frames: Sequence["Frame"]) -> str:
        """Take the sensor, as it is now, for a zero of the kind that the session has; says so."""
        from eitskin.training.pipeline.stored_reference import Zero

        zero, board = Zero.FLAT if self.stored is None else self.stored.zero, self.connection.board
        self.stored = pipeline.tare(frames, zero, board_number(board.info), board.uri)
        text = f"zero: the sensor {zero}, mean of {len(frames)} frames"
        self.say(text)
        return text

    def notice_session(self, frame: "Frame") -> None:
        """Note the beginning of a session, and findings on the sensor there."""
        from eitskin.training.pipeline.session_order import SessionOrder

        self.order = self.order or SessionOrder()
        step = self.order.follow(frame)
        for problem in step.problems:
            self.say(problem)
        if step.new_session:
            zero = "the sensor must be flat and untouched now"
            if self.stored is not None:
                zero = "the stored reference stays in use"
            self.say(f"session {frame.session} begins: the board has started anew, and {zero}")
            self.beginning = []
        if self.expected is None or len(self.beginning) >= CHECKED:
            return
        self.beginning.append(frame)
        if len(self.beginning) == CHECKED:
            from eitskin.hardware.diagnosis.sensor_check import check_sensor

            for finding in check_sensor(self.beginning, self.expected).findings:
                self.say(f"sensor check: {finding.message}")

    def say(self, text: str) -> None:
        """Show a note beside the live view, or on stderr where there is no view."""
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
        if age < longest_silence(period, SHORTEST_SILENCE):
            return ""
        return f"nothing for {age:.0f} s" + f"; {self.connection.problem}" * bool(
            self.connection.problem
        )

    def view(self) -> RenderableType:
        """Panel of the newest reading and notes."""
        from eitskin.cli.live_view import draw

        notes = [Text(note, style="yellow") for note in self.notes]
        if self.newest is None:
            waiting = self.connection.problem or "waiting for the first frame"
            return Group(*notes, Text(waiting))
        return Group(*notes, draw(self.newest, self.connection.board.counts, self.silence()))

    def sum_up(self) -> None:
        """Note totals of the session: frames, losses, latency."""
        import numpy as np

        from eitskin.cli.live_view import losses

        unusable = self.newest.unusable if self.newest is not None else 0
        text = f"{self.processed} frames processed, "
        text += losses(self.connection.board.counts, unusable)
        if self.latencies:
            half, most = np.percentile(self.latencies, (50, 99)) * 1e3
            text += f"; latency {half:.1f} ms median, {most:.1f} ms p99"
        if self.node is not None and self.node.refused:
            text += f"; {self.node.refused} ROS 2 messages found no room"
        self.output.note(text)
