"""Named resolutions: polynomial orders and cell sizes for any design."""

import math
from typing import Literal, TypeAlias, get_args

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh_design import CellKind

Resolution = Literal["fast", "standard", "fine"]
Discretisation: TypeAlias = tuple[tuple[int, ...], Grading]

# Orders in the plane for the constant, linear, quadratic ... part along the height; finest cell
# relative to the smallest electrode, coarsest cell relative to the body's shorter side, and growth.
# Presses tilt and shear the layer, which couples the parts, so that all parts need nearly the same
# order. `eitskin bench accuracy` measures cost and error of each resolution.
_COLUMNS: dict[str, tuple[tuple[int, ...], float, float, float]] = {
    "fast": ((3, 2, 1), 0.2, 0.1, 4.0),
    "standard": ((3, 2, 2), 0.04, 0.11, 2.2),
    "fine": ((5, 4, 3), 4e-3, 0.13, 2.0),
}
# Triangles are refined around electrode edges only, not along whole lines, and can be finer.
_PRISMS: dict[str, tuple[tuple[int, ...], float, float, float]] = {
    "fast": ((2, 2, 1), 0.2, 0.12, 1.2),
    "standard": ((3, 2, 2), 0.04, 0.13, 1.2),
    "fine": ((4, 3, 2), 4e-3, 0.13, 1.5),
}
_TETRAHEDRA: dict[str, tuple[tuple[int, ...], float, float, float]] = {
    "fast": ((2,), 0.3, 0.10, 0.7),
    "standard": ((2,), 0.1, 0.08, 0.7),
    "fine": ((2,), 0.04, 0.08, 0.5),
}
_NAMED = {"hexahedra": _COLUMNS, "prisms": _PRISMS, "tetrahedra": _TETRAHEDRA}


def discretisation(
    resolution: Resolution | Discretisation, design: SensorDesign, cells: CellKind
) -> Discretisation:
    """Order and grading of a named resolution for a design; a discretisation stays as it is.

    Raises ConfigurationError for an unknown name.
    """
    if not isinstance(resolution, str):
        return resolution
    if resolution not in get_args(Resolution):
        raise ConfigurationError(
            f"resolution must be one of {', '.join(get_args(Resolution))}, got '{resolution}'"
        )
    order, finest, coarsest, growth = _NAMED[cells][resolution]
    extents = [e.width for e in design.electrodes]
    extents += [e.height for e in design.electrodes if e.height is not None]
    largest = coarsest * min(design.outline.length, design.outline.width)
    layers = max(1, math.ceil(design.thickness / largest - 0.1))
    return order, Grading(min(finest * min(extents), largest), largest, growth, layers)
