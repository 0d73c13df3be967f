"""`eitskin reconstruct SOURCE`: pictures of the conductivity change, without training."""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, get_args

import typer
from rich.table import Column

from eitskin import geometry, hardware, simulator, training
from eitskin.cli import options
from eitskin.cli.commands.live.session import LiveSession
from eitskin.cli.commands.recorded_frames import FrameOptions, PicturedFrames
from eitskin.cli.page.access import PageOptions, tell_invitations
from eitskin.errors import ConfigurationError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from eitskin.training.evaluation.drawing import Circle

OVERSHOOT = 5.0  # of a picture's falls, from which on they are not those of a strong change


@options.with_output
def command(
    source: Annotated[
        str,
        typer.Argument(help="Dataset folder or shard, scene file (.toml), or board URI."),
    ],
    *,
    wanted: FrameOptions,
    method: Annotated[
        Literal[
            "back-projection", "tikhonov", "noser", "laplace", "total-variation", "greit", "all"
        ]
        | None,
        typer.Option("--method", help="Method; greit if omitted, or laplace with --segment."),
    ] = None,
    rule: Annotated[
        str | None,
        typer.Option(
            "--lambda",
            help="Rule: noise-figure:1, snr:100, gcv, or lambda:0.01; noise-figure:1 if omitted, "
            "or snr:300 with --segment.",
        ),
    ] = None,
    difference: Annotated[
        Literal["relative", "absolute"] | None,
        typer.Option(
            "--difference",
            help="Divide each channel by its reference, or subtract; by the protocol if omitted.",
        ),
    ] = None,
    segment: Annotated[
        bool,
        typer.Option("--segment", help="Also find regions of lower and of higher conductivity."),
    ] = False,
    pixels: Annotated[int, typer.Option(help="Approximate number of pixels.")] = 2250,
    resolution: options.Detail = "fast",
    out: Annotated[
        Path | None,
        typer.Option(help="Image (.png), or values with their positions (.npz, .csv)."),
    ] = None,
    page: PageOptions,
    seed: int = 0,
    output: options.Output,
) -> None:
    """Reconstruct a conductivity image (EIT); no training needed."""
    import numpy as np

    from eitskin.hardware.opening import is_board
    from eitskin.training.reconstruction.pixel_grid import picture_regions
    from eitskin.training.reconstruction.reconstructor import (
        REGION_METHOD,
        REGION_RULE,
        Method,
        suited_difference,
    )

    chosen = method or (REGION_METHOD if segment else "greit")
    names: list[Method] = [chosen] if chosen != "all" else [*get_args(Method)]
    chosen_rule = training.Regularisation.from_text(
        rule or (REGION_RULE if segment else "noise-figure:1")
    )
    _require_out(out)

    def makers(
        design: "geometry.SensorDesign", protocol: "simulator.Protocol", *before: Any
    ) -> list[training.Reconstructor]:
        suited = difference or (suited_difference(protocol, before[0]) if before else None)
        common = chosen_rule, pixels, suited, resolution
        return [training.Reconstructor(design, protocol, name, *common) for name in names]

    if page.page:
        if not is_board(source) or len(names) > 1:
            raise ConfigurationError(
                f"--page is for one method on a board (serial:, text: ...), got {source!r} with "
                f"{', '.join(names)}; write the pictures of other sources with --out"
            )
        _follow_live(source, wanted, makers, page, seed, output)
        return
    frames = wanted.read(source, resolution, seed, output)
    reconstructors = makers(frames.design, frames.protocol, frames.reference)
    if (mirrored := reconstructors[0].ambiguous_share) > 0.2:
        output.note(
            f"with {frames.protocol}, {mirrored:.0%} of the places of this sensor read as another "
            "one: the picture may show a change on the other side, too; measure by adjacent pairs"
        )
    images = [image for maker in reconstructors for image in _images(maker, frames)]
    if not np.isfinite(images[0].noise).any() and not source.endswith(".toml"):
        output.note("no five frames of the untouched sensor, so nothing says what is noise")
    regions = [picture_regions(each.values, each.maker.grid) for each in images if segment]
    beyond = [image for image in images if np.nanmin(image.values) < -1]
    if beyond:
        least = min(np.nanmin(each.values) for each in beyond)
        why = "linear pictures draw strong changes too strong"
        if least < -OVERSHOOT:
            why = "the frames and the sensor do not fit; check protocol, order and reference"
        output.note(
            f"no conductivity falls by more than 100 %, but {len(beyond)} pictures do, to "
            f"{100 * least:.3g} %, which are cut there: {why}"
        )
        images = [image._replace(values=np.maximum(image.values, -1.0)) for image in images]
    rows = [image.as_dict() for image in images]
    for row, each in zip(rows, regions, strict=False):
        row["regions"] = [region._asdict() for region in each]
    data = {
        "source": source,
        "protocol": str(frames.protocol),
        "pictures": rows,
        "out": None if out is None else str(out),
    }
    headings = ("frame", Column("method", no_wrap=True), "lambda")
    ends = ("least, %", "at, mm", "largest, %", "at, mm")
    output.result(data, options.make_table((*headings, *ends), map(_cells, rows), pad_edge=False))
    for row in rows if segment else ():
        for region in row["regions"]:
            x, y = (1e3 * each for each in region["centre"])
            output.show(
                f"{row['frame']}, {row['method']}: {100 * region['change']:+.3g} % over "
                f"{1e6 * region['area']:.3g} mm2 at {x:.0f}, {y:.0f} mm"
            )
    if out is not None:
        _write(out, images)
        output.note(f"written: {out}")


class Image(NamedTuple):
    """Picture of one frame by one method.

    Attributes:
        maker: maker of the picture.
        frame: name of the frame.
        values: relative change of conductivity (rows, columns), dimensionless; NaN outside.
        circles: true touches, where known.
        noise: size of values that noise alone makes (rows, columns); NaN where unknown.
        classes: -1 and +1 in regions of lower and of higher conductivity, 0 elsewhere.
    """

    maker: "training.Reconstructor"
    frame: str
    values: "NDArray[np.float64]"
    circles: "tuple[Circle, ...]"
    noise: "NDArray[np.float64]"
    classes: "NDArray[np.int8]"

    def as_dict(self) -> dict[str, Any]:
        """Method, and least and largest value with their positions [m].

        No lambda where there is none, or where each frame chose its own.
        """
        import numpy as np

        maker, values = self.maker, self.values[self.maker.grid.inside]
        common = maker.method != "back-projection" and maker.regularisation.rule != "gcv"
        low, high = int(values.argmin()), int(values.argmax())
        noise = self.noise[self.maker.grid.inside]
        known = bool(np.isfinite(noise).all())
        return {
            "frame": self.frame,
            "method": maker.method,
            "difference": maker.difference,
            "lambda": maker.choose_lambda() if common else None,
            "least": float(values[low]),
            "least_at_m": maker.grid.centres[low].tolist(),
            "largest": float(values[high]),
            "largest_at_m": maker.grid.centres[high].tolist(),
            "noise": float(np.median(noise)) if known else None,
            "least_is_noise": bool(-values[low] <= noise[low]) if known else None,
            "largest_is_noise": bool(values[high] <= noise[high]) if known else None,
        }


def _images(maker: "training.Reconstructor", frames: PicturedFrames) -> "list[Image]":
    """Pictures of all frames by one method, and their noise."""
    import numpy as np

    from eitskin.training.reconstruction.pixel_grid import segment
    from eitskin.training.reconstruction.reconstructor import VISIBLE

    still = frames.still
    changes = maker.data(still, still.mean(axis=0)) if len(still) else np.zeros(still.shape)
    noise = VISIBLE * maker.noise(changes)
    pictures = maker.images(maker.data(frames.impedance, frames.reference))
    named = zip(frames.names, pictures, frames.circles, strict=True)
    return [Image(maker, *each, noise, segment(each[1], maker.grid)) for each in named]


def _cells(row: dict[str, Any]) -> list[str]:
    """Cells of the table of pictures: extremes of one of them."""
    cells = [row["frame"], row["method"], f"{row['lambda']:.3g}" if row["lambda"] else "-"]
    for which in ("least", "largest"):
        x, y = row[f"{which}_at_m"]
        place = "noise" if row[f"{which}_is_noise"] else f"{1e3 * x:.0f}, {1e3 * y:.0f}"
        cells += [f"{100 * row[which]:+.3g}", place]
    return cells


def _follow_live(
    uri: str,
    wanted: FrameOptions,
    makers: "Callable[..., list[training.Reconstructor]]",
    page: PageOptions,
    seed: int,
    output: options.Output,
) -> None:
    """Serve the page with the board's pictures until Ctrl-C, or the end of a recording."""
    from eitskin.cli.live_pictures import LivePictures
    from eitskin.cli.page.live_page import LivePage

    access, design = page.access, options.read_design(wanted.sensor)
    with ExitStack() as stack:
        stack.enter_context(options.ended_by_signals())
        board = stack.enter_context(options.opened_board(uri, seed))
        wanted.require_protocol(design, board.protocol, "the board measures")
        (maker,) = makers(design, board.protocol)
        session = LiveSession(hardware.Connection(board), output, LivePictures(maker))
        session.connection.tell = session.say
        served = LivePage(session.connection, design, page.page_port, access)
        session.page = stack.enter_context(served)
        tell_invitations(session.page.invitations, output)
        output.note("keep the sensor untouched at first")
        session.follow(hardware.run_live(session.connection, session), None)


def _require_out(out: Path | None) -> None:
    """Refuse, before any computation, a file of an unknown kind or a folder that is missing."""
    if out is None:
        return
    if out.suffix.lower() not in (".png", ".npz", ".csv"):
        raise ConfigurationError(
            f"expected --out as .png, .npz or .csv, got {out.name}; name such a file"
        )
    options.require_parent(out)
    if out.suffix.lower() == ".png":
        from eitskin.extras import require

        require("matplotlib", "view")


def _write(out: Path, images: list[Image]) -> None:
    """Write the pictures in the form of the file's suffix; those of one method on one scale."""

    import numpy as np

    from eitskin.files import atomic_file

    methods = list(dict.fromkeys(image.maker.method for image in images))
    frames = list(dict.fromkeys(image.frame for image in images))
    grid, kind = images[0].maker.grid, out.suffix.lower()
    with atomic_file(out) as temporary:
        if kind == ".png":
            from eitskin.training.evaluation.drawing import PicturePanel, draw_panels, style

            panels = []
            for maker, frame, values, circles, noise, _ in images:
                title = f"{frame}: {maker.method}" if len(frames) > 1 else maker.method
                shown = PicturePanel(title, maker.design, maker.grid, values, circles, noise=noise)
                panels.append(shown)
            with style():
                draw_panels(panels, common=len(methods) == 1).savefig(temporary)
        elif kind == ".npz":
            change = np.array([image.values for image in images])
            np.savez_compressed(
                temporary,
                x=grid.x,
                y=grid.y,
                inside=grid.inside,
                change=change.reshape(len(methods), len(frames), *grid.shape),
                noise=np.array([image.noise for image in images[:: len(frames)]]),
                classes=np.array([image.classes for image in images]).reshape(
                    len(methods), len(frames), *grid.shape
                ),
                methods=np.array(methods),
                frames=np.array(frames),
            )
        else:
            names = [
                f"{image.maker.method} {image.frame}" if len(methods) > 1 else image.frame
                for image in images
            ]
            np.savetxt(
                temporary,
                np.column_stack([grid.centres, *(image.values[grid.inside] for image in images)]),
                delimiter=",",
                header=",".join(["x_m", "y_m", *names]),
                comments="",
                fmt="%.8g",
            )
