"""Mirror symmetries of a sensor and its protocol, by which every frame counts up to four times."""

import dataclasses
import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.protocol import Protocol

Array = NDArray[np.float64]

_GRID = 37  # points along x and along y at which an outline is compared with its image
MOST_ORDERED = 64  # electrodes, of which wrong orders are tried
_TOLERANCE = 1e-6  # m, between an electrode and the mirror image of another


@dataclass(frozen=True, slots=True, eq=False)
class Mirror:
    """One mirror symmetry, or the identity.

    Attributes:
        flips: whether x and whether y are reversed.
        order: the mirrored sensor's measurement i has the magnitude of the sensor's order[i], (m,).
        size: length and width of the sensor [m].
    """

    flips: tuple[bool, bool]
    order: NDArray[np.int64]
    size: tuple[float, float]

    def places(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Mirror images of positions x and y (...) [m]."""
        (length, width), (flip_x, flip_y) = self.size, self.flips
        return (length - x if flip_x else x), (width - y if flip_y else y)


def mirrors(design: SensorDesign, protocol: Protocol) -> tuple[Mirror, ...]:
    """All mirror symmetries of a sensor and its protocol, the identity first.

    The hinge lies in the middle and bends about y, so it breaks none of the sensor's symmetries.
    """
    length, width = design.outline.length, design.outline.width
    places = np.array([[e.x, e.y] for e in design.electrodes])
    found = []
    for flips in ((False, False), (True, False), (False, True), (True, True)):
        image = np.where(flips, (length, width) - places, places)
        distance = np.linalg.norm(image[:, None] - places[None], axis=2)
        partner = distance.argmin(axis=1)
        same = (
            _same_outline(design, flips)
            and distance.min(axis=1).max() < _TOLERANCE
            and all(_alike(design, a, b) for a, b in enumerate(partner.tolist()))
        )
        order = _order(np.array(protocol.table), partner) if same else None
        if order is not None:
            found.append(Mirror(flips, order, (length, width)))
    return tuple(found)


def electrode_orders(protocol: Protocol) -> Iterator[tuple[str, NDArray[np.int64]]]:
    """Wrong orders of the electrodes, in words, and the measurements that these exchange.

    Two electrodes are exchanged, or all are counted from another one, in either direction; none of
    more than `MOST_ORDERED` electrodes, whose pairs are too many to try.

    Yields:
        name: of the order.
        order: number of the measurement that is in each one's place (m,).
    """
    numbers = np.arange(protocol.n_electrodes)
    if len(numbers) > MOST_ORDERED:
        return
    orders = []
    for a, b in itertools.combinations(numbers.tolist(), 2):
        exchanged = numbers.copy()
        exchanged[[a, b]] = b, a
        orders.append((f"electrodes {a} and {b} exchanged", exchanged))
    for first, way in itertools.product(numbers.tolist(), ("", "backwards ")):
        counted = (first + (-numbers if way else numbers)) % len(numbers)
        orders.append((f"electrodes counted {way}from {first} on", counted))
    table = np.array(protocol.table)
    for name, partner in orders:
        if (order := _order(table, partner)) is not None:
            yield name, order


def _alike(design: SensorDesign, a: int, b: int) -> bool:
    """Whether two electrodes differ in nothing but their position."""
    one, other = (dataclasses.replace(design.electrodes[i], x=0.0, y=0.0) for i in (a, b))
    return one == other


def _same_outline(design: SensorDesign, flips: tuple[bool, bool]) -> bool:
    """Whether the outline equals its mirror image, on a grid of points."""
    if isinstance(design.outline, Surface):
        return not any(flips)
    length, width = design.outline.length, design.outline.width
    steps = (np.arange(_GRID) + 0.5) / _GRID
    x, y = (axis.ravel() for axis in np.meshgrid(steps * length, steps * width))
    mirrored = np.stack([length - x if flips[0] else x, width - y if flips[1] else y], axis=1)
    here, there = (design.outline.contains(p) for p in (np.stack([x, y], axis=1), mirrored))
    return bool(np.array_equal(here, there))


def _order(table: NDArray[np.int64], partner: NDArray[np.intp]) -> NDArray[np.int64] | None:
    """Number of each measurement's image (m,) under partners of the electrodes.

    None where a protocol's table (m, 4) lacks one. Reversed polarities change the sign of a
    measurement, not its magnitude.
    """
    codes, images = _codes(table, len(partner)), _codes(partner[table], len(partner))
    sorter = np.argsort(codes, kind="stable")
    order = sorter[np.searchsorted(codes[sorter], images, "right") - 1]
    return order if np.array_equal(codes[order], images) else None


def _codes(table: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Numbers (m,), the same for rows whose pairs of electrodes are the same in either order."""
    low, high = np.moveaxis(np.sort(table.reshape(-1, 2, 2), axis=2), 2, 0)
    drive, sense = (low * count + high).T
    codes: NDArray[np.int64] = drive * count**2 + sense
    return codes
