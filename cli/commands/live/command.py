"""`eitskin live`: live estimates of a board's sensor, in the terminal and on a page."""

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from eitskin import datasets, hardware, training
from eitskin.cli import options
from eitskin.cli.commands.live.session import LiveSession, Recording
from eitskin.cli.commands.tare import ReferenceFile, tell_unjudged, use_reference
from eitskin.cli.page.access import PageOptions, tell_invitations
from eitskin.errors import ConfigurationError, PartialError

if TYPE_CHECKING:
    from eitskin.training.reconstruction.reconstructor import Method


@options.with_output
def command(
    model: options.Model,
    *,
    board: options.BoardOption = None,
    frames: Annotated[
        int | None, typer.Option(min=1, help="Number of frames; until Ctrl-C if omitted.")
    ] = None,
    record: Annotated[
        Path | None, typer.Option(help="Also write every frame into a new dataset in this folder.")
    ] = None,
    mcap: Annotated[
        Path | None,
        typer.Option(
            help="Also write frames and estimates, as ROS 2 messages, into this .mcap file."
        ),
    ] = None,
    every_frame: Annotated[
        bool,
        typer.Option("--every-frame", help="Process all frames, not only the newest."),
    ] = False,
    page: PageOptions,
    page_folder: Annotated[
        Path, typer.Option(help="Folder for recordings and pipelines made from the page.")
    ] = Path("page-files"),
    udp: Annotated[
        str | None,
        typer.Option("--udp", metavar="[HOST:]PORT", help="Also send every reading by UDP."),
    ] = None,
    websocket: Annotated[
        str | None,
        typer.Option(
            "--websocket",
            metavar="[HOST:]PORT",
            help="Also serve readings by WebSocket; 0 for a free port.",
        ),
    ] = None,
    reference: ReferenceFile = None,
    method: options.MethodCode = None,
    picture: Annotated[
        Literal["back-projection", "tikhonov", "noser", "laplace", "greit"] | None,
        typer.Option(help="Also reconstruct an image of every frame, for the page."),
    ] = None,
    ros2: Annotated[
        bool, typer.Option("--ros2", help="Also publish frames and estimates as ROS 2 topics.")
    ] = False,
    ros2_domain: Annotated[
        int, typer.Option(envvar="ROS_DOMAIN_ID", help="Number of the DDS domain, 0 to 232.")
    ] = 0,
    ros2_namespace: Annotated[
        str, typer.Option(help="Name of this skin in its topics and frames.")
    ] = "eitskin",
    seed: int = 0,
    output: options.Output,
) -> None:
    """Run a pipeline live on a board: state, angle and touches of its sensor.

    The sensor must be flat and untouched when a session begins: at the start, and whenever the
    board restarts. With a stored reference it may be bent and touched. If the board goes away,
    the session reconnects.
    """
    from eitskin.hardware.streams import open_publisher

    board = options.named_board(board)
    access = page.access if page.page else None  # refused before the board is opened
    own = options.own_method(method)
    pipeline = training.open_pipeline(model, own)
    tell_missing(pipeline, output)
    recordings: list[Recording] = []
    with ExitStack() as stack:
        # Asked last, when all are closed: most sessions are ended by Ctrl-C.
        stack.push(partial(_tell_losses, recordings))
        stack.enter_context(options.ended_by_signals())
        for recording in _recordings(record, mcap):
            recordings.append(stack.enter_context(closing(recording)))
        opened = stack.enter_context(options.opened_board(board, seed, pipeline.layout))
        pipeline.layout.require_same_measurements(opened.protocol, opened.info.frequency)
        output.detail(f"{opened.uri}: firmware {opened.info.firmware}, {opened.protocol.labels}")
        if reference is not None:
            use_reference(pipeline, reference, opened.info, output)
        tell_unjudged(pipeline, output)
        # A recording was checked when it was made, and need not begin flat.
        checks = not board.startswith("replay:")
        session = LiveSession(hardware.Connection(opened), output, pipeline, checks, recordings)
        session.connection.tell = session.say
        if page.page:
            from eitskin.cli.commands.live.tasks import SessionTasks
            from eitskin.cli.page.drawing import sensor_or_region
            from eitskin.cli.page.live_page import LivePage

            tasks = stack.enter_context(SessionTasks(session, page_folder, model, own))
            session.page = stack.enter_context(
                LivePage(
                    session.connection, sensor_or_region(pipeline), page.page_port, access, tasks
                )
            )
            tell_invitations(session.page.invitations, output)
        if ros2:
            from eitskin.hardware.ros2.skin_node import SkinNode

            node = SkinNode(ros2_namespace, ros2_domain, session.tare)
            session.node = stack.enter_context(node)
            output.note(f"ROS 2: topics of /{node.name} in domain {ros2_domain}")
        if udp is not None or websocket is not None:
            publisher = open_publisher(session.connection, udp, websocket)
            session.publisher = stack.enter_context(publisher)
            for address in publisher.addresses:
                output.note(f"readings: {address}")
        newest = not (every_frame or recordings)
        followed = session if picture is None else _picture_pipeline(session, opened, picture)
        session.follow(hardware.run_live(session.connection, followed, newest=newest), frames)


def _picture_pipeline(
    session: LiveSession, board: "hardware.Board", method: "Method"
) -> "hardware.FramePipeline":
    """Pipeline with a picture of each frame, of the sensor that the pipeline was trained for."""
    from eitskin.cli.live_pictures import LivePictures
    from eitskin.cli.page.drawing import Region, sensor_or_region

    sheet = sensor_or_region(session.pipeline)
    if isinstance(sheet, Region):
        raise ConfigurationError(
            "expected a pipeline that knows its sensor's geometry, for pictures, got one trained "
            "without; leave out --picture, or train it on a recording imported with --sensor"
        )
    return LivePictures(training.Reconstructor(sheet, board.protocol, method), session)


def tell_missing(pipeline: "training.Pipeline", output: options.Output) -> None:
    """Note what a pipeline does not estimate."""
    targets = getattr(pipeline, "targets", None)
    if targets is not None and targets.missing:
        output.note(f"this pipeline does not estimate {', '.join(targets.missing)}")


def _tell_losses(recordings: Sequence[Recording], _: object, ended: object, __: object) -> None:
    """Raise PartialError for what could not be written, unless another error ended the session."""
    lost = [recording.loss for recording in recordings if recording.loss]
    if lost and (ended is None or isinstance(ended, KeyboardInterrupt)):
        raise PartialError("; ".join(lost))


def _recordings(record: Path | None, mcap: Path | None) -> Iterator[Recording]:
    """Recordings of the session; existing files are never replaced.

    The file comes first: where it cannot be, no folder has been made.
    """
    if mcap is not None:
        from eitskin.hardware.ros2.messages import McapWriter

        yield Recording(McapWriter(mcap, now=time.time_ns), mcap)
    if record is not None:
        yield Recording(datasets.ShardWriter(record), record)
