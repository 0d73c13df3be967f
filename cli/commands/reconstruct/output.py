"""Pictures of `eitskin reconstruct` as a table, as JSON, and as files."""

from pathlib import Path
from typing import TYPE_CHECKING, cast

from rich.table import Table

from eitskin.errors import ConfigurationError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from eitskin.cli.commands.reconstruct.sources import PicturedFrames
    from eitskin.training.reconstruction.reconstructor import Reconstructor


def require_out(out: Path | None) -> None:
    """Refuse, before any computation, a file of an unknown kind or a folder that is missing."""
    if out is None:
        return
    if out.suffix.lower() not in (".png", ".npz", ".csv"):
        raise ConfigurationError(
            f"expected --out as .png, .npz or .csv, got {out.name}; name such a file"
        )
    if not out.absolute().parent.is_dir():
        raise ConfigurationError(
            f"cannot write {out}: there is no folder {out.parent}; make it, or name another"
        )
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
