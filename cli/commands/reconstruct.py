"""`eitskin reconstruct SOURCE`: pictures of the conductivity change, without training."""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast, get_args

import typer
from rich.table import Table

from eitskin.cli.commands.live.session import LiveSession
from eitskin.cli.commands.pictured_frames import SCHEMES, pictured_frames
from eitskin.cli.options import (
    MeasuredPairs,
    Output,
    SensorFile,
    ended_by_signals,
    one_of,
    read_design,
    require_parent,
    seeded,
    with_output,
)
from eitskin.cli.page.access import (
    Access,
    PageHost,
    PagePort,
    PageTokenFile,
    ShowPage,
    tell_invitations,
)
from eitskin.errors import ConfigurationError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from eitskin.cli.commands.pictured_frames import PicturedFrames
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


@with_output
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
    seed: int = 0,
    output: Output,
) -> None:
    """Picture where the conductivity of any sensor has changed, without a trained pipeline."""
    import numpy as np

    from eitskin.simulator.electrical.resolution import Resolution
    from eitskin.training.reconstruction.reconstructor import Difference, Method, Reconstructor
    from eitskin.training.reconstruction.regularised_inverse import Regularisation

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
        access = Access.of(page_host, page_token_file)
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
    from eitskin.hardware.boards.board import Connection
    from eitskin.hardware.live import run_live
    from eitskin.hardware.opening import open_board
    from eitskin.protocol import Protocol

    design = read_design(sensor)
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
        tell_invitations(session.page.invitations, output)
        output.note("keep the sensor untouched at first")
        session.follow(run_live(session.connection, pipeline), None)


def require_out(out: Path | None) -> None:
    """Refuse, before any computation, a file of an unknown kind or a folder that is missing."""
    if out is None:
        return
    if out.suffix.lower() not in (".png", ".npz", ".csv"):
        raise ConfigurationError(
            f"expected --out as .png, .npz or .csv, got {out.name}; name such a file"
        )
    require_parent(out)
    if out.suffix.lower() == ".png":
        from eitskin.extras import require

        require("matplotlib", "view")


def as_data(
    source: str,
    taken: "PicturedFrames",
    makers: "list[Reconstructor]",
    pictures: "list[NDArray[np.float64]]",
    out: Path | None,
) -> dict[str, object]:
    """Extremes of all pictures as plain data."""
    return {
        "source": source,
        "protocol": str(taken.protocol),
        "pictures": [
            {
                "frame": name,
                "method": maker.method,
                "difference": maker.difference,
                "lambda": _lambda(maker),
                **_extremes(maker, picture),
            }
            for maker, images in zip(makers, pictures, strict=True)
            for name, picture in zip(taken.names, images, strict=True)
        ],
        "out": None if out is None else str(out),
    }


def _extremes(maker: "Reconstructor", picture: "NDArray[np.float64]") -> dict[str, object]:
    """Least and largest value of a picture, and their positions [m]."""
    values, centres = picture[maker.grid.inside], maker.grid.centres
    low, high = int(values.argmin()), int(values.argmax())
    return {
        "least": float(values[low]),
        "least_at_m": centres[low].tolist(),
        "largest": float(values[high]),
        "largest_at_m": centres[high].tolist(),
    }


def _lambda(maker: "Reconstructor") -> float | None:
    """Regularisation parameter; None where there is none, or where each frame chose its own."""
    if maker.method == "back-projection" or maker.regularisation.rule == "gcv":
        return None
    return maker.lambda_of()


def as_table(
    taken: "PicturedFrames", makers: "list[Reconstructor]", pictures: "list[NDArray[np.float64]]"
) -> Table:
    """Table of the extremes of all pictures."""
    table = Table("frame", "method", "lambda", "least, %", "at, mm", "largest, %", "at, mm")
    table.pad_edge, table.columns[1].no_wrap = False, True  # whole in 80 columns
    for maker, images in zip(makers, pictures, strict=True):
        parameter = _lambda(maker)
        for name, picture in zip(taken.names, images, strict=True):
            found = _extremes(maker, picture)
            cells = []
            for which in ("least", "largest"):
                x, y = cast("list[float]", found[f"{which}_at_m"])
                cells += [f"{100 * cast('float', found[which]):+.3g}"]
                cells += [f"{1e3 * x:.0f}, {1e3 * y:.0f}"]
            table.add_row(name, maker.method, f"{parameter:.3g}" if parameter else "-", *cells)
    return table


def write_pictures(
    out: Path,
    taken: "PicturedFrames",
    makers: "list[Reconstructor]",
    pictures: "list[NDArray[np.float64]]",
) -> None:
    """Write the pictures in the form of the file's suffix."""
    import numpy as np

    from eitskin.files import atomic_file

    kind = out.suffix.lower()
    if kind == ".png":
        _draw(out, taken, makers, pictures)
        return
    grid = makers[0].grid
    with atomic_file(out) as temporary:
        if kind == ".npz":
            np.savez_compressed(
                temporary,
                x=grid.x,
                y=grid.y,
                inside=grid.inside,
                change=np.array(pictures),
                methods=np.array([maker.method for maker in makers]),
                frames=np.array(taken.names),
            )
            return
        names = [
            f"{maker.method} {name}" if len(makers) > 1 else name
            for maker in makers
            for name in taken.names
        ]
        columns = [image[grid.inside] for images in pictures for image in images]
        np.savetxt(
            temporary,
            np.column_stack([grid.centres, *columns]),
            delimiter=",",
            header=",".join(["x_m", "y_m", *names]),
            comments="",
            fmt="%.8g",
        )


def _draw(
    out: Path,
    taken: "PicturedFrames",
    makers: "list[Reconstructor]",
    pictures: "list[NDArray[np.float64]]",
) -> None:
    """Draw all pictures; those of one method on one scale."""
    from eitskin.files import atomic_file
    from eitskin.training.evaluation.report.drawing import PicturePanel, draw_panels, style

    panels = [
        PicturePanel(
            f"{name}: {maker.method}" if len(taken.names) > 1 else maker.method,
            maker.design,
            maker.grid,
            picture,
            circles,
        )
        for maker, images in zip(makers, pictures, strict=True)
        for name, picture, circles in zip(taken.names, images, taken.circles, strict=True)
    ]
    with style(), atomic_file(out) as temporary:
        draw_panels(panels, common=len(makers) == 1).savefig(temporary)
