"""`eitskin reconstruct SOURCE`: pictures of the conductivity change, without training."""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast, get_args

import typer

from eitskin.cli.commands.live.page_options import (
    PageHost,
    PagePort,
    PageTokenFile,
    ShowPage,
    page_access,
    tell_page,
)
from eitskin.cli.commands.live.session import LiveSession
from eitskin.cli.commands.reconstruct.output import (
    as_data,
    as_table,
    require_out,
    write_pictures,
)
from eitskin.cli.commands.reconstruct.sources import SCHEMES, pictured_frames
from eitskin.cli.options import (
    Json,
    MeasuredPairs,
    Output,
    Quiet,
    Seed,
    SensorFile,
    Verbose,
    ended_by_signals,
    one_of,
    seeded,
)
from eitskin.errors import ConfigurationError

if TYPE_CHECKING:
    from eitskin.cli.page.access import Access
    from eitskin.geometry.design.sensor import SensorDesign
    from eitskin.protocol import Protocol
    from eitskin.simulator.electrical.resolution import Resolution
    from eitskin.training.reconstruction.reconstructor import Difference, Method, Reconstructor

Source = Annotated[
    str,
    typer.Argument(help="Dataset folder or shard, scene file (.toml), or board URI."),
]
MethodName = Annotated[
    str,
    typer.Option(
        "--method",
        help="back-projection, tikhonov, noser, laplace, total-variation, greit, or all.",
    ),
]
Rule = Annotated[
    str, typer.Option("--lambda", help="noise-figure:1, snr:100, gcv, or lambda:0.01.")
]
DifferenceName = Annotated[
    str | None,
    typer.Option(
        "--difference",
        help="relative (channel by channel) or absolute; chosen by the protocol when omitted.",
    ),
]
Chosen = Annotated[
    str | None,
    typer.Option("--frames", help="Frames of a dataset, as 0,5,10-12; of a board, how many."),
]
Reference = Annotated[
    str, typer.Option(help="Reference of a dataset's frames: untouched, flat, or a frame number.")
]
Averaged = Annotated[
    int, typer.Option(min=1, help="First frames of a board, untouched, that make its reference.")
]
Out = Annotated[
    Path | None, typer.Option(help="Picture (.png), or values with their positions (.npz, .csv).")
]


def command(
    source: Source,
    *,
    sensor: SensorFile = None,
    protocol: MeasuredPairs = None,
    method: MethodName = "greit",
    rule: Rule = "noise-figure:1",
    difference: DifferenceName = None,
    frames: Chosen = None,
    reference: Reference = "untouched",
    average: Averaged = 16,
    pixels: Annotated[int, typer.Option(help="Pixels of the bounding box, about.")] = 2250,
    resolution: Annotated[str, typer.Option(help="coarse, fast, standard or fine.")] = "fast",
    out: Out = None,
    page: ShowPage = False,
    page_port: PagePort = 8940,
    page_host: PageHost = "127.0.0.1",
    page_token_file: PageTokenFile = None,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Picture where the conductivity of any sensor has changed, without a trained pipeline."""
    import numpy as np

    from eitskin.simulator.electrical.resolution import Resolution
    from eitskin.training.reconstruction.reconstructor import Difference, Method, Reconstructor
    from eitskin.training.reconstruction.regularised_inverse import Regularisation

    output = Output(as_json, quiet, verbose)
    names = list(get_args(Method)) if method == "all" else [one_of("--method", method, Method)]
    chosen_rule = Regularisation.named(rule)
    compared = None if difference is None else one_of("--difference", difference, Difference)
    detail = cast("Resolution", one_of("--resolution", resolution, Resolution))
    require_out(out)

    def maker(design: "SensorDesign", protocol: "Protocol", name: str) -> Reconstructor:
        return Reconstructor(
            design,
            protocol,
            cast("Method", name),
            chosen_rule,
            pixels,
            cast("Difference | None", compared),
            detail,
        )

    if page:
        access = page_access(page_host, page_token_file)
        _follow_live(source, sensor, protocol, names, maker, (page_port, access), seed, output)
        return
    taken = pictured_frames(
        source, sensor, protocol, frames, reference, average, detail, seed, output
    )
    impedance, before = np.array(taken.impedance), np.array(taken.reference)
    makers = [maker(taken.design, taken.protocol, name) for name in names]
    pictures = [each.images(each.data(impedance, before)) for each in makers]
    output.result(as_data(source, taken, makers, pictures, out), as_table(taken, makers, pictures))
    if out is not None:
        write_pictures(out, taken, makers, pictures)
        output.note(f"written: {out}")


def _follow_live(
    uri: str,
    sensor: Path | None,
    protocol: str | None,
    methods: list[str],
    maker: "Callable[[SensorDesign, Protocol, str], Reconstructor]",
    served: "tuple[int, Access]",
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
    from eitskin.hardware.boards.board import Connection
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
        session.page = stack.enter_context(LivePage(session.connection, design, *served))
        tell_page(session.page, output)
        output.note("keep the sensor untouched at first")
        session.follow(run_live(session.connection, pipeline), None)
