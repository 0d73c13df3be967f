"""Live pictures of a board on the page, for `eitskin reconstruct URI --page`."""

from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING

from eitskin.cli.commands.live import LiveSession, seeded
from eitskin.cli.commands.reconstruct_sources import SCHEMES
from eitskin.cli.options import Output, ended_by_signals
from eitskin.errors import ConfigurationError

if TYPE_CHECKING:
    from eitskin.geometry.design.sensor import SensorDesign
    from eitskin.protocol import Protocol
    from eitskin.training.reconstruction.reconstructor import Reconstructor


def picture_live(
    uri: str,
    sensor: Path | None,
    protocol: str | None,
    methods: list[str],
    maker: "Callable[[SensorDesign, Protocol, str], Reconstructor]",
    page_port: int,
    seed: int,
    output: Output,
) -> None:
    """Serve the page with the board's pictures until Ctrl-C, or the end of a recording.

    Raises ConfigurationError for a source that is no board, and for several methods.
    """
    if not uri.startswith(SCHEMES) or len(methods) > 1:
        raise ConfigurationError(
            f"--page is for one method on a board ({', '.join(SCHEMES)}), got {uri!r} with "
            f"{', '.join(methods)}; write the pictures of other sources with --out"
        )
    from eitskin.cli.live_pictures import LivePictures, PicturePipeline
    from eitskin.cli.page.live_page import LivePage
    from eitskin.geometry.design.sensor import SensorDesign
    from eitskin.hardware.boards.connection import Connection
    from eitskin.hardware.live import run_live
    from eitskin.hardware.opening import open_board
    from eitskin.protocol import Protocol

    design = SensorDesign.from_toml(sensor) if sensor else SensorDesign.reference()
    with ExitStack() as stack:
        stack.enter_context(ended_by_signals())
        board = stack.enter_context(open_board(uri, **seeded(uri, seed)))
        if protocol:
            Protocol.named(protocol, len(design.electrodes)).require_same(
                board.protocol, "--protocol names", "the board measures", "leave --protocol out"
            )
        pipeline = PicturePipeline(LivePictures(maker(design, board.protocol, methods[0])))
        session = LiveSession(Connection(board), output)
        session.connection.tell = session.say
        session.page = stack.enter_context(closing(LivePage(session.connection, design, page_port)))
        output.note(f"page: {session.page.url}; keep the sensor untouched at first")
        session.follow(run_live(session.connection, pipeline), None)
