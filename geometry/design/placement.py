"""Placement of electrodes on a body: regular layouts, and the check that no two overlap."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from eitskin.bounds import MOST_ELECTRODES, require_count
from eitskin.errors import ConfigurationError
from eitskin.geometry.design.contact_areas import (
    Pad,
    Strip,
    beyond,
    half_planes,
    on_plane,
    on_side,
    on_surface,
    tangents,
)
from eitskin.geometry.design.electrode import Electrode, Shape
from eitskin.geometry.design.outline import Outline, PlaneOutline
from eitskin.geometry.design.surface import Surface

Array = NDArray[np.float64]

_DIGITS = 12  # of positions in m, so that round numbers stay round
_SAME = 1e-9  # electrodes that overlap by less touch only [m]


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
        outline: of the layer.
        count: how many, at least two.
        width: of each along the outline [m].
        start: arc length of the first one's centre; half the pitch when omitted [m].
        contact_impedance: of each [ohm m2].
        height: of each, the full thickness when omitted [m].
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
        for x, y in outline.at(first + pitch * np.arange(count))
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
        outline: of the layer.
        rows: how many along y.
        columns: how many along x.
        size: of each along x and y [m].
        on: the face that carries them, or inside.
        contact_impedance: of each [ohm m2].
        z: height of the sheets, for those inside [m].
        shape: of each.

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
    fitting = tuple(pads[i] for i, c in enumerate(corners) if not beyond(outline, c))
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


ContactArea = Strip | Pad


def placed(
    electrodes: Sequence[Electrode], outline: Outline, thickness: float
) -> list[ContactArea]:
    """Contact areas of electrodes on a body.

    Raises ConfigurationError, naming the electrode, for the first one that is off the body.
    """
    contacts = []
    for number, electrode in enumerate(electrodes):
        try:
            contacts.append(_placed(electrode, outline, thickness))
        except ConfigurationError as error:
            raise ConfigurationError(f"electrode {number}: {error}") from error
    return contacts


def require_apart(contacts: Sequence[ContactArea]) -> None:
    """Raise ConfigurationError, naming both, for the first two contacts that overlap.

    Strips are compared in the unrolled side, pads in their common plane; a surface is taken as
    flat between two pads.
    """
    centres = np.array([contact.centre for contact in contacts])
    reach = np.array([contact.reach for contact in contacts])
    apart = np.linalg.norm(centres[:, None] - centres, axis=-1)
    near = np.argwhere(np.triu(apart < reach[:, None] + reach, k=1))
    for i, j in near.tolist():
        overlap = _overlap(contacts[i], contacts[j])
        if overlap > _SAME:
            where = "along the outline" if isinstance(contacts[i], Strip) else "in their plane"
            raise ConfigurationError(
                f"electrodes {i} and {j} overlap by {overlap * 1e3:.4g} mm {where}; move them "
                "apart or make them narrower"
            )


def _placed(electrode: Electrode, outline: Outline, thickness: float) -> ContactArea:
    if isinstance(outline, Surface) != (electrode.on == "surface"):
        raise ConfigurationError(
            'on = "surface" goes with the surface of a file as outline and with nothing else; got '
            f'on = "{electrode.on}" with a {type(outline).__name__}'
        )
    if isinstance(outline, Surface):
        return on_surface(electrode, outline)
    if electrode.on == "side":
        return on_side(electrode, outline, thickness)
    return on_plane(electrode, outline, thickness)


def _overlap(first: ContactArea, second: ContactArea) -> float:
    """Overlap of two contacts [m]; not above 0 where they are apart."""
    if isinstance(first, Strip) and isinstance(second, Strip):
        return _strips_overlap(first, second)
    if isinstance(first, Pad) and isinstance(second, Pad) and first.on == second.on:
        return _pads_overlap(first, second)
    return 0.0


def _strips_overlap(first: Strip, second: Strip) -> float:
    perimeter = first.outline.perimeter
    between = abs(first.start + first.end - second.start - second.end) / 2.0 % perimeter
    widths = (first.end - first.start + second.end - second.start) / 2.0
    around = widths - min(between, perimeter - between)
    upwards = min(first.high, second.high) - max(first.low, second.low)
    return min(around, upwards)


def _pads_overlap(first: Pad, second: Pad) -> float:
    """Smallest shift in the first pad's plane that parts two pads (separating axes) [m]."""
    apart = second.centre - first.centre
    if first.normal @ second.normal < 0.5 or abs(apart @ first.normal) > (
        _SAME if first.on == "inside" else first.depth + second.depth
    ):
        return 0.0
    axes = tangents(first.normal)
    a, b = ((pad.corners - first.centre) @ axes.T for pad in (first, second))
    outward = np.concatenate([half_planes(a), half_planes(b)])[:, :2]
    high = np.minimum((a @ outward.T).max(axis=0), (b @ outward.T).max(axis=0))
    low = np.maximum((a @ outward.T).min(axis=0), (b @ outward.T).min(axis=0))
    return float((high - low).min())
