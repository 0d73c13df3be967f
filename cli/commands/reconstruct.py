"""`eitskin reconstruct SOURCE`: pictures of the conductivity change, without training."""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, get_args

import typer
from rich.table import Table

from eitskin.cli.commands.live.session import LiveSession
from eitskin.cli.commands.pictured_frames import SCHEMES, PicturedFrame, pictured_frames
from eitskin.cli.options import (
    Detail,
    MeasuredPairs,
    Output,
    SensorFile,
    ended_by_signals,
    one_of,
    opened_board,
    read_design,
    require_parent,
    with_output,
)
from eitskin.cli.page.access import Access, PageOptions, tell_invitations
from eitskin.errors import ConfigurationError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from eitskin.geometry.design.sensor import SensorDesign
    from eitskin.protocol import Protocol
    from eitskin.training.reconstruction.reconstructor import Method, Reconstructor

Reference = Annotated[
    str, typer.Option(help="Reference of a dataset's frames: untouched, flat, or a frame number.")
]


@with_output
def command(
    source: Annotated[
        str,
        typer.Argument(help="Dataset folder or shard, scene file (.toml), or board URI."),
    ],
    *,
    sensor: SensorFile = None,
    protocol: MeasuredPairs = None,
    method: Annotated[
        str,
        typer.Option(
            "--method",
            help="back-projection, tikhonov, noser, laplace, total-variation, greit, or all.",
        ),
    ] = "greit",
    rule: Annotated[
        str, typer.Option("--lambda", help="noise-figure:1, snr:100, gcv, or lambda:0.01.")
    ] = "noise-figure:1",
    difference: Annotated[
        str | None,
        typer.Option(
            "--difference",
            help="relative (channel by channel) or absolute; chosen by the protocol when omitted.",
        ),
    ] = None,
    frames: Annotated[
        str | None,
        typer.Option("--frames", help="Frames of a dataset, as 0,5,10-12; of a board, how many."),
    ] = None,
    reference: Reference = "untouched",
    average: Annotated[
        int,
        typer.Option(min=1, help="First frames of a board, untouched, that make its reference."),
    ] = 16,
    pixels: Annotated[int, typer.Option(help="Pixels of the bounding box, about.")] = 2250,
    resolution: Detail = "fast",
    out: Annotated[
        Path | None,
        typer.Option(help="Picture (.png), or values with their positions (.npz, .csv)."),
    ] = None,
    page: PageOptions,
    seed: int = 0,
    output: Output,
) -> None:
    """Picture where the conductivity of any sensor has changed, without a trained pipeline."""
    import numpy as np

    from eitskin.simulator.electrical.resolution import Resolution
    from eitskin.training.reconstruction.reconstructor import Difference, Method, Reconstructor
    from eitskin.training.reconstruction.regularised_inverse import Regularisation

    names: list[Method] = (
        [one_of("--method", method, Method)] if method != "all" else [*get_args(Method)]
    )
    chosen_rule = Regularisation.named(rule)
    compared = None if difference is None else one_of("--difference", difference, Difference)
    detail = one_of("--resolution", resolution, Resolution)
    _require_out(out)

    def maker(design: "SensorDesign", protocol: "Protocol", name: "Method") -> Reconstructor:
        return Reconstructor(
            design,
            protocol,
            name,
            chosen_rule,
            pixels,
            compared,
            detail,
        )

    if page.page:
        served = page.page_port, page.access
        _follow_live(source, sensor, protocol, names, maker, served, seed, output)
        return
    taken = pictured_frames(
        source, sensor, protocol, frames, reference, average, detail, seed, output
    )
    impedance = np.array([each.impedance for each in taken.frames])
    before = np.array([each.reference for each in taken.frames])
    images = [
        Image(each, frame, values)
        for each in (maker(taken.design, taken.protocol, name) for name in names)
        for frame, values in zip(
            taken.frames, each.images(each.data(impedance, before)), strict=True
        )
    ]
    data = {
        "source": source,
        "protocol": str(taken.protocol),
        "pictures": [each.as_dict() for each in images],
        "out": None if out is None else str(out),
    }
    output.result(data, _as_table(images))
    if out is not None:
        _write(out, images)
        output.note(f"written: {out}")


class Image(NamedTuple):
    """Picture of one frame by one method: relative change of conductivity (rows, columns)."""

    maker: "Reconstructor"
    frame: PicturedFrame
    values: "NDArray[np.float64]"

    @property
    def parameter(self) -> float | None:
        """Regularisation; None where there is none, or where each frame chose its own."""
        maker = self.maker
        if maker.method == "back-projection" or maker.regularisation.rule == "gcv":
            return None
        return maker.lambda_of()

    def as_dict(self) -> dict[str, Any]:
        """Method, and least and largest value with their positions [m]."""
        values, centres = self.values[self.maker.grid.inside], self.maker.grid.centres
        low, high = int(values.argmin()), int(values.argmax())
        return {
            "frame": self.frame.name,
            "method": self.maker.method,
            "difference": self.maker.difference,
            "lambda": self.parameter,
            "least": float(values[low]),
            "least_at_m": centres[low].tolist(),
            "largest": float(values[high]),
            "largest_at_m": centres[high].tolist(),
        }


def _follow_live(
    uri: str,
    sensor: Path | None,
    protocol: str | None,
    methods: "list[Method]",
    maker: "Callable[[SensorDesign, Protocol, Method], Reconstructor]",
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
    from eitskin.protocol import Protocol

    design = read_design(sensor)
    with ExitStack() as stack:
        stack.enter_context(ended_by_signals())
        board = stack.enter_context(opened_board(uri, seed))
        if protocol:
            Protocol.named(protocol, len(design.electrodes)).require_same(
                board.protocol, "--protocol names", "the board measures", "leave --protocol out"
            )
        pipeline = PicturePipeline(LivePictures(maker(design, board.protocol, methods[0])))
        session = LiveSession(Connection(board), output, pipeline)
        session.connection.tell = session.say
        session.page = stack.enter_context(LivePage(session.connection, design, *served))
        tell_invitations(session.page.invitations, output)
        output.note("keep the sensor untouched at first")
        session.follow(run_live(session.connection, session), None)


def _require_out(out: Path | None) -> None:
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


def _as_table(images: list[Image]) -> Table:
    """Table of the extremes of all pictures."""
    table = Table("frame", "method", "lambda", "least, %", "at, mm", "largest, %", "at, mm")
    table.pad_edge, table.columns[1].no_wrap = False, True  # whole in 80 columns
    for each in images:
        found, parameter = each.as_dict(), each.parameter
        cells = [found["frame"], found["method"], f"{parameter:.3g}" if parameter else "-"]
        for which in ("least", "largest"):
            x, y = found[f"{which}_at_m"]
            cells += [f"{100 * found[which]:+.3g}", f"{1e3 * x:.0f}, {1e3 * y:.0f}"]
        table.add_row(*cells)
    return table


def _write(out: Path, images: list[Image]) -> None:
    """Write the pictures in the form of the file's suffix; those of one method on one scale."""
    import numpy as np

    from eitskin.files import atomic_file

    methods = list(dict.fromkeys(each.maker.method for each in images))
    frames = list(dict.fromkeys(each.frame.name for each in images))
    grid, kind = images[0].maker.grid, out.suffix.lower()
    with atomic_file(out) as temporary:
        if kind == ".png":
            from eitskin.training.evaluation.drawing import PicturePanel, draw_panels, style

            panels = []
            for maker, frame, values in images:
                title = f"{frame.name}: {maker.method}" if len(frames) > 1 else maker.method
                panels.append(PicturePanel(title, maker.design, maker.grid, values, frame.circles))
            with style():
                draw_panels(panels, common=len(methods) == 1).savefig(temporary)
        elif kind == ".npz":
            change = np.array([each.values for each in images])
            np.savez_compressed(
                temporary,
                x=grid.x,
                y=grid.y,
                inside=grid.inside,
                change=change.reshape(len(methods), len(frames), *grid.shape),
                methods=np.array(methods),
                frames=np.array(frames),
            )
        else:
            names = [
                f"{maker.method} {frame.name}" if len(methods) > 1 else frame.name
                for maker, frame, _ in images
            ]
            np.savetxt(
                temporary,
                np.column_stack([grid.centres, *(each.values[grid.inside] for each in images)]),
                delimiter=",",
                header=",".join(["x_m", "y_m", *names]),
                comments="",
                fmt="%.8g",
            )
