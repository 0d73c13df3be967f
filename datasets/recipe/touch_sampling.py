"""Places that are pressed: drawing them, and what they may be."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.schema import MAX_TOUCHES
from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import PlaneOutline
from eitskin.simulator.scene.indenters import Cylinder

_INDENTER = 2.0 * Cylinder().radius
_SETS_AT_ONCE = 16
_TRIES = 1600


def draw_places(
    amount: int, outline: PlaneOutline, margin: float, spacing: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Draw `amount` places (x, y) [m] that keep their distances, all such sets equally likely.

    Whole sets are drawn and refused: placing one touch after another would favour the rim.
    Raises ConfigurationError where none of many sets keeps the distances.
    """
    low = np.array([margin, margin])
    high = np.array([outline.length, outline.width]) - margin
    first, second = np.triu_indices(amount, k=1)
    for _ in range(_TRIES):
        sets = rng.uniform(low, high, size=(_SETS_AT_ONCE, amount, 2))
        apart = np.linalg.norm(sets[:, first] - sets[:, second], axis=-1)
        within = outline.contains(sets, margin).all(axis=1)
        good = np.flatnonzero((apart >= spacing).all(axis=1) & within)
        if good.size:
            places: NDArray[np.float64] = sets[good[0]]
            return places
    raise ConfigurationError(
        f"could not place {amount} touches {spacing:g} m apart and {margin:g} m from the rim; ask "
        "for fewer touches, or less spacing or margin"
    )


def place_problems(places: Sequence[tuple[float, float]], outline: PlaneOutline) -> Iterator[str]:
    """Places (x, y) [m] that are not on the sensor."""
    for x, y in places:
        if not outline.contains(np.array([x, y])):
            yield (
                f"position ({x:g}, {y:g}) m is off the {outline.length:g} x "
                f"{outline.width:g} m sensor; are the units metres?"
            )


def touch_problems(
    force: tuple[float, float],
    touches: tuple[int, int],
    margin: float,
    spacing: float,
    outline: PlaneOutline,
) -> Iterator[str]:
    """Why touches in these ranges cannot be drawn; see `SceneGroup`."""
    few, many = touches
    if not 0.0 < force[0] <= force[1]:
        yield f"force must be a rising range above 0 N, got {list(force)}"
    if not 1 <= few <= many <= MAX_TOUCHES:
        yield f"touches must be from 1 to {MAX_TOUCHES}, got {list(touches)}"
    elif not (margin >= 0.0 and 2.0 * margin < min(outline.length, outline.width)):
        yield (
            f"margin must be at least 0 and leave room on the {outline.length:g} x "
            f"{outline.width:g} m sensor, got {margin:g} m"
        )
    elif not spacing >= _INDENTER:
        yield f"spacing must be at least the indenter's {_INDENTER:g} m, got {spacing:g}"
    elif not _has_room(many, outline, margin, spacing):
        yield (
            f"{many} touches {spacing:g} m apart and {margin:g} m from the rim do "
            "not fit, or almost never; ask for fewer, or less spacing or margin"
        )


def _has_room(amount: int, outline: PlaneOutline, margin: float, spacing: float) -> bool:
    try:
        draw_places(amount, outline, margin, spacing, np.random.default_rng(0))
    except ConfigurationError:
        return False
    return True
