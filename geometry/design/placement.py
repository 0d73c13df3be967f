"""Placement of electrodes on a body, and the check that no two overlap."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.electrode import Electrode
from eitskin.geometry.design.flat_contacts import Pad, half_planes, on_plane, on_surface, tangents
from eitskin.geometry.design.outline import Outline
from eitskin.geometry.design.side_contacts import Strip, on_side
from eitskin.geometry.design.surface import Surface

Array = NDArray[np.float64]
ContactArea = Strip | Pad

_SAME = 1e-9  # electrodes that overlap by less touch only [m]


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
