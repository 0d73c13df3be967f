"""Named resolutions: polynomial orders and cell sizes for any design and indenter."""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh_design import (
    CellKind,
    electrode_lines,
    level_edges,
    natural_cells,
)
from eitskin.simulator.scene.indenters import Cylinder, Indenter

Resolution = Literal["coarse", "fast", "standard", "fine"]
Discretisation: TypeAlias = tuple[tuple[int, ...], Grading]


class _ResolutionSettings(NamedTuple):
    """Sizes of a named resolution, relative to lengths of the design.

    Attributes:
        order: order in the plane for the constant, linear, quadratic ... part along the height. A
            shear of the whole layer couples the parts, so that all need nearly the same order;
            presses and bends hardly do.
        finest: finest cell, relative to the smallest electrode.
        coarsest: coarsest cell, relative to the body's shorter side.
        growth: growth of the cells from the electrode edges.
        per_press: coarsest cell, relative to the length over which a press varies.
        layers: fewest cells through the thickness.
    """

    order: tuple[int, ...]
    finest: float
    coarsest: float
    growth: float
    per_press: float
    layers: int = 1


# `eitskin bench accuracy` measures cost and error of each resolution.
_COLUMNS = {
    "coarse": _ResolutionSettings((3, 3, 2), 0.32, 0.136, 5.0, 0.85),
    "fast": _ResolutionSettings((4, 3, 2), 0.32, 0.136, 5.0, 0.85),
    "standard": _ResolutionSettings((4, 4, 3, 2), 0.04, 0.11, 3.0, 0.68),
    "fine": _ResolutionSettings((5, 5, 5, 4, 3), 4e-3, 0.083, 2.0, 0.52),
}
# Electrodes on top of a rectangle, where currents turn within the layer.
_PADS = _COLUMNS | {"fast": _ResolutionSettings((3, 3, 2, 1), 0.2, 0.1, 2.0, 0.62)}
# Electrodes on the side lower than the layer, over whose height currents turn: all parts along the
# height have the same order. The growth of cells decides about the error, the finest cell hardly.
_LOW: dict[CellKind, dict[str, _ResolutionSettings]] = {
    "hexahedra": {
        "coarse": _ResolutionSettings((3, 3, 3), 0.64, 0.136, 3.0, 0.85),
        "fast": _ResolutionSettings((3, 3, 3), 0.32, 0.136, 2.0, 0.85),
        "standard": _ResolutionSettings((4, 4, 4), 0.32, 0.11, 2.0, 0.68, 6),
        "fine": _ResolutionSettings((4, 4, 4, 4), 0.2, 0.1, 2.0, 0.6, 6),
    },
    "prisms": {
        "coarse": _ResolutionSettings((3, 3, 3), 0.32, 0.23, 3.0, 1.4),
        "fast": _ResolutionSettings((3, 3, 3), 0.16, 0.16, 2.0, 0.89),
        "standard": _ResolutionSettings((4, 4, 4), 0.16, 0.15, 2.0, 0.89, 6),
        "fine": _ResolutionSettings((4, 4, 4, 4), 0.1, 0.1, 2.0, 0.62, 6),
    },
}
# Their finest cell upwards, relative to the lowest electrode.
_FINEST_LEVEL = {"coarse": 0.64, "fast": 0.32, "standard": 0.32, "fine": 0.2}
# Triangles are refined around electrode edges only, not along whole lines, and can be finer.
_PRISMS = {
    "coarse": _ResolutionSettings((4, 3, 2), 0.12, 0.23, 1.7, 1.4),
    "fast": _ResolutionSettings((4, 3, 2, 1), 0.2, 0.16, 1.3, 0.89),
    "standard": _ResolutionSettings((4, 4, 3, 2, 2), 0.04, 0.15, 1.6, 0.89),
    "fine": _ResolutionSettings((4, 4, 4, 3, 2), 4e-3, 0.1, 1.2, 0.62),
}
_TETRAHEDRA = {
    "coarse": _ResolutionSettings((2,), 0.4, 0.14, 1.0, math.inf),
    "fast": _ResolutionSettings((2,), 0.3, 0.10, 0.7, math.inf),
    "standard": _ResolutionSettings((2,), 0.1, 0.08, 0.7, math.inf),
    "fine": _ResolutionSettings((2,), 0.04, 0.08, 0.5, math.inf),
}
_SETTINGS_BY_NAME = {"hexahedra": _COLUMNS, "prisms": _PRISMS, "tetrahedra": _TETRAHEDRA}

# Crossings of lines through electrode ends up to which hexahedra are as fast as prisms.
_MAX_CROSSINGS = {"coarse": 300, "fast": 50, "standard": 50, "fine": 50}
_TOLERANCE = 1e-9  # [m]

_TIP_HEIGHT = 1e-3  # height over an indenter's lowest point at which the radius is measured [m]
_SUFFICIENT = 0.9  # of the wanted cell size over the size of a mesh that is still used
_STEP = 1.25  # ratio of cell sizes of finer meshes


def faster_resolutions(resolution: Resolution | Discretisation) -> tuple[Resolution, ...]:
    """Names of faster resolutions, the finest first; all names after a discretisation."""
    names: tuple[Resolution, ...] = get_args(Resolution)
    end = names.index(resolution) if isinstance(resolution, str) else len(names)
    return names[:end][::-1]


def press_length(design: SensorDesign, indenter: Indenter) -> float:
    """Length over which the deformation of the layer by an indenter varies [m].

    The cover between indenter and layer and the mean over half the layer smooth a press as the
    width of the indenter does. Indenters wider than the default one count as the default one,
    since their rims are as sharp.
    """
    cover = 0.5 * (design.encapsulated_thickness - design.thickness)
    widest = min(indenter.rims[1], Cylinder().radius)
    r = np.linspace(0.0, widest, 65)
    radius = float(r[indenter.profile(r)[0] <= _TIP_HEIGHT][-1])
    return cover + 0.5 * design.thickness + 0.5 * radius


def suited_cells(
    resolution: Resolution | Discretisation, design: SensorDesign, breaks: Sequence[float] = ()
) -> CellKind:
    """Kind of mesh of a resolution for a design.

    Electrodes on the sides of a rectangle that are not opposite each other have lines of hexahedra
    for each. At named resolutions triangles take their place where that makes too many. Meshes with
    `breaks`, further faces across x, have hexahedra.
    """
    kind = natural_cells(design)
    if kind != "hexahedra" or not isinstance(resolution, str) or breaks or not _on_sides(design):
        return kind
    extents = design.outline.length, design.outline.width
    along, across = (
        sum(_TOLERANCE < at < extent - _TOLERANCE for at in lines)
        for lines, extent in zip(electrode_lines(design), extents, strict=True)
    )
    return "prisms" if along * across > _MAX_CROSSINGS.get(resolution, 0) else kind


def _on_sides(design: SensorDesign) -> bool:
    return all(electrode.on == "side" for electrode in design.electrodes)


def discretisation(
    resolution: Resolution | Discretisation,
    design: SensorDesign,
    cells: CellKind,
    indenter: Indenter | None = None,
) -> Discretisation:
    """Order and grading of a named resolution for a design; a discretisation stays as it is.

    Args:
        resolution: the name, or element order and grading.
        design: the sensor.
        cells: kind of mesh.
        indenter: the smallest of those that will press the sensor; the default cylinder when
            omitted. Sizes for smaller indenters are rounded down, so that similar indenters share
            a mesh.

    Raises ConfigurationError for an unknown name.
    """
    if not isinstance(resolution, str):
        return resolution
    if resolution not in get_args(Resolution):
        raise ConfigurationError(
            f"resolution must be one of {', '.join(get_args(Resolution))}, got '{resolution}'"
        )
    named, level = _SETTINGS_BY_NAME[cells][resolution], None
    widths = [e.width for e in design.electrodes]
    heights = [e.height for e in design.electrodes if e.height is not None]
    if cells in _LOW and _on_sides(design) and level_edges(design):
        named, level = _LOW[cells][resolution], _FINEST_LEVEL[resolution] * min(heights)
    else:
        widths += heights
    if cells == "hexahedra" and not _on_sides(design):
        named = _PADS[resolution]
    largest = named.coarsest * min(design.outline.length, design.outline.width)
    largest = min(largest, named.per_press * press_length(design, Cylinder()))
    if indenter is not None:
        cell_size = named.per_press * press_length(design, indenter)
        while cell_size < _SUFFICIENT * largest:
            largest /= _STEP
    layers = max(named.layers, math.ceil(design.thickness / largest - 0.5))
    finest = min(named.finest * min(widths), largest)
    return named.order, Grading(finest, largest, named.growth, layers, level)
