"""Regular electrode layouts: uniform around the side, or a grid of pads."""

from typing import Literal

import numpy as np

from eitskin.bounds import MOST_ELECTRODES, require_count
from eitskin.errors import ConfigurationError
from eitskin.geometry.design.electrode import Electrode, Shape
from eitskin.geometry.design.outline import Outline, PlaneOutline, overhang
from eitskin.geometry.design.surface import Surface

_DIGITS = 12  # of positions in m, so that round numbers stay round


def uniform(
    outline: Outline,
    count: int,
    width: float = 0.005,
    start: float | None = None,
    contact_impedance: complex = 1e-3,
    height: float | None = None,
    z: float | None = None,
) -> tuple[Electrode, ...]:
    """Electrodes at equal distances of arc length around the side, counter-clockwise.

    Args:
        outline: outline of the layer.
        count: number of electrodes, at least two.
        width: width of each electrode along the outline [m].
        start: arc length of the first one's centre; half the pitch when omitted [m].
        contact_impedance: contact impedance of each electrode [ohm m2].
        height: height of each electrode, the full thickness when omitted [m].
        z: height of their centres, the middle when omitted [m].

    Raises ConfigurationError for fewer than two electrodes, a surface, and invalid sizes.
    """
    outline = _plane(outline)
    require_count("the count of a uniform layout", count, 2, MOST_ELECTRODES)
    pitch = outline.perimeter / count
    first = 0.5 * pitch if start is None else start
    if not np.isfinite(first):
        raise ConfigurationError(f"start must be a finite arc length in m, got {first}")
    return tuple(
        Electrode(_round(x), _round(y), width, contact_impedance, height, z)
        for x, y in outline.rim_points(first + pitch * np.arange(count))
    )


def grid(
    outline: Outline,
    rows: int,
    columns: int,
    size: float,
    on: Literal["top", "bottom", "inside"] = "top",
    contact_impedance: complex = 1e-3,
    z: float | None = None,
    shape: Shape = "rectangle",
) -> tuple[Electrode, ...]:
    """Pads in the middles of rows x columns equal fields of the outline's bounding box.

    Pads are numbered along x first, then along y. Pads that would reach beyond the outline, as in
    the corners of a disc's box, are left out.

    Args:
        outline: outline of the layer.
        rows: number of pads along y.
        columns: number of pads along x.
        size: extent of each pad along x and y [m].
        on: the face that carries them, or inside.
        contact_impedance: contact impedance of each electrode [ohm m2].
        z: height of the sheets, for those inside [m].
        shape: shape of each pad.

    Raises ConfigurationError where pads overlap or none fits, and for a surface.
    """
    outline = _plane(outline)
    require_count("the rows of a grid", rows, 1, MOST_ELECTRODES)
    require_count(f"the columns of a grid of {rows} rows", columns, 1, MOST_ELECTRODES // rows)
    pitch_x, pitch_y = outline.length / columns, outline.width / rows
    if size > min(pitch_x, pitch_y):
        raise ConfigurationError(
            f"a grid of {rows} rows and {columns} columns has room for pads of "
            f"{min(pitch_x, pitch_y):g} m, got a size of {size:g} m"
        )
    pads = [
        Electrode(_round(x), _round(y), size, contact_impedance, z=z, on=on, shape=shape)
        for y in pitch_y * (np.arange(rows) + 0.5)
        for x in pitch_x * (np.arange(columns) + 0.5)
    ]
    corners = [np.add(pad.footprint(), (pad.x, pad.y)) for pad in pads]
    fitting = tuple(pads[i] for i, c in enumerate(corners) if not overhang(outline, c))
    if not fitting:
        raise ConfigurationError("no pad of the grid fits on the outline; make the pads smaller")
    return fitting


def _plane(outline: Outline) -> PlaneOutline:
    if isinstance(outline, Surface):
        raise ConfigurationError(
            "layouts go with a rectangle, disc or polygon; list the electrodes of a surface"
        )
    return outline


def _round(value: float) -> float:
    return round(float(value), _DIGITS) + 0.0  # + 0.0 makes -0.0 a plain zero
