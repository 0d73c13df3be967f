"""Mesh of a design, by the kind of cells."""

from collections.abc import Sequence
from typing import Literal, get_args

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.hexahedra import structured_mesh
from eitskin.geometry.meshing.mesh import Mesh
from eitskin.geometry.meshing.prisms import triangulated_mesh
from eitskin.geometry.meshing.quality import check_quality

CellKind = Literal["hexahedra", "prisms", "tetrahedra"]


def natural_cells(design: SensorDesign) -> CellKind:
    """Default kind of cells of a design.

    Hexahedra for rectangles, prisms for other plane outlines, tetrahedra for surfaces.
    """
    if isinstance(design.outline, Surface):
        return "tetrahedra"
    return "hexahedra" if isinstance(design.outline, Rectangle) else "prisms"


def mesh_design(
    design: SensorDesign,
    grading: Grading,
    cells: CellKind | None = None,
    breaks: Sequence[float] = (),
) -> Mesh:
    """Mesh a design and check the quality of the cells.

    Args:
        design: the sensor.
        grading: cell sizes.
        cells: kind of cells; `natural_cells(design)` when omitted.
        breaks: further x at which hexahedra have faces [m]; other cells ignore them.

    Raises:
        ConfigurationError: where the cells cannot fill the outline, or some are misshapen.
        ImportError: for tetrahedra without the extra "mesh".
    """
    cells = cells or natural_cells(design)
    if cells not in get_args(CellKind):
        raise ConfigurationError(
            f"cells must be one of {', '.join(get_args(CellKind))}, got {cells!r}"
        )
    if cells == "hexahedra":
        mesh = structured_mesh(design, grading, breaks)
    elif cells == "prisms":
        mesh = triangulated_mesh(design, grading)
    else:
        from eitskin.geometry.meshing.tetrahedra import tetrahedral_mesh

        mesh = tetrahedral_mesh(design, grading)
    check_quality(mesh)
    return mesh
