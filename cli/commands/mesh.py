"""`eitskin mesh`: the mesh of a design in numbers and as a picture."""

import dataclasses
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer
from rich.table import Table

from eitskin import geometry
from eitskin.cli.options import (
    Detail,
    Output,
    SensorFile,
    electrode_pair,
    one_of,
    read_design,
    with_output,
)
from eitskin.errors import ConfigurationError

if TYPE_CHECKING:
    from eitskin.geometry.meshing.mesh_design import CellKind
    from eitskin.simulator.electrical.resolution import Resolution


@with_output
def command(
    *,
    sensor: SensorFile = None,
    resolution: Detail = "standard",
    cells: Annotated[
        str | None,
        typer.Option(help="hexahedra, prisms or tetrahedra; what suits the outline when omitted."),
    ] = None,
    view: Annotated[Path | None, typer.Option(help="Draw the mesh into this PNG file.")] = None,
    drive: Annotated[
        str | None, typer.Option(help="With --view: draw what a current from A to B does, as A,B.")
    ] = None,
    output: Output,
) -> None:
    """Mesh a sensor: number of cells, their quality, and a picture."""
    from eitskin.geometry.meshing.mesh_design import CellKind, mesh_design
    from eitskin.simulator.electrical.resolution import discretisation, suited_cells
    from eitskin.simulator.view.render import require_picture

    design = read_design(sensor)
    named = cast("Resolution", resolution)
    suited = suited_cells(named, design)
    kind = one_of("--cells", cells, CellKind) if cells else suited
    pair = None if drive is None else electrode_pair(drive, len(design.electrodes))
    if pair is not None and view is None:
        raise ConfigurationError("--drive says what to draw; name the picture with --view")
    if view is not None:
        require_picture(view)
    start = time.perf_counter()
    _, grading = discretisation(named, design, kind)
    mesh = mesh_design(design, grading, kind)
    data = _numbers(design, mesh, kind, time.perf_counter() - start)
    output.result(data, _as_table(data))
    if view is not None:
        _draw(design, mesh, kind, pair, view)
        output.note(f"picture: {view}")


def _numbers(
    design: "geometry.SensorDesign", mesh: "geometry.Mesh", kind: "CellKind", seconds: float
) -> dict[str, Any]:
    """Numbers of the mesh as plain data."""
    import numpy as np

    from eitskin.geometry.meshing.mesh import quality

    asked = np.array([patch.area for patch in design.patches()])
    found = np.bincount(mesh.contacts.electrode, mesh.contacts.areas, len(asked))
    return {
        "kind": kind,
        **dataclasses.asdict(quality(mesh)),
        "electrodes": len(asked),
        "electrode_area_error": float(np.abs(found / asked - 1.0).max()),
        "seconds": seconds,
    }


def _as_table(data: dict[str, Any]) -> Table:
    table = Table("mesh", "", show_header=False)
    table.columns[1].justify = "right"
    for name, value in (
        ("cells", f"{data['cells']} {data['kind']}"),
        ("points", f"{data['points']}"),
        ("volume", f"{1e6 * data['volume']:.4g} cm3"),
        ("least scaled Jacobian, 1 is best", f"{data['scaled_jacobian']:.3g}"),
        ("longest to shortest edge, worst", f"{data['aspect_ratio']:.3g}"),
        ("longest to shortest edge, median", f"{data['median_aspect_ratio']:.3g}"),
        (
            "angles between faces",
            f"{data['smallest_angle']:.1f} to {data['largest_angle']:.1f} deg",
        ),
        ("electrodes", f"{data['electrodes']}"),
        ("largest error of an electrode's area", f"{data['electrode_area_error']:.1e}"),
        ("time", f"{data['seconds']:.2f} s"),
    ):
        table.add_row(name, value)
    return table


def _draw(
    design: "geometry.SensorDesign",
    mesh: "geometry.Mesh",
    kind: "CellKind",
    drive: tuple[int, int] | None,
    path: Path,
) -> None:
    from eitskin.simulator.view.model_pictures import draw_drive, draw_mesh, model_for_pictures

    if drive is None:
        draw_mesh(mesh, path)
    else:
        draw_drive(model_for_pictures(design, kind), drive, path, mesh)
