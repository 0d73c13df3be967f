"""Random touch positions, and checks of their ranges."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.schema import MAX_TOUCHES
from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import PlaneOutline
from eitskin.simulator.scene.indenters import Indenter

_SETS_AT_ONCE = 16
_TRIES = 1600


def draw_positions(
    amount: int, outline: PlaneOutline, margin: float, spacing: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Random positions (amount, 2) [m], uniform over all sets with the given distances.

    Rejection sampling of whole sets: placing one touch after another would favour the rim.

    Args:
        amount: number of touches.
        outline: of the sensor.
        margin: least distance from the rim [m].
        spacing: least distance between two touches [m].
        rng: random generator.

    Raises ConfigurationError where no set of many has these distances.
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
            positions: NDArray[np.float64] = sets[good[0]]
            return positions
    raise ConfigurationError(
        f"could not place {amount} touches {spacing:g} m apart and {margin:g} m from the rim; ask "
        "for fewer touches, or less spacing or margin"
    )


def position_problems(
    positions: Sequence[tuple[float, float]], outline: PlaneOutline
) -> Iterator[str]:
    """Positions (x, y) [m] off the sensor, a sentence each."""
    for x, y in positions:
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
    indenter: Indenter,
) -> Iterator[str]:
    """Reasons why touches in these ranges cannot be drawn, a sentence each; see `SceneGroup`."""
    few, many = touches
    across = 2.0 * indenter.rims[1]
    if not 0.0 < force[0] <= force[1]:
        yield f"force must be a rising range above 0 N, got {list(force)}"
    if not 1 <= few <= many <= MAX_TOUCHES:
        yield f"touches must be from 1 to {MAX_TOUCHES}, got {list(touches)}"
    elif not (margin >= 0.0 and 2.0 * margin < min(outline.length, outline.width)):
        yield (
            f"margin must be at least 0 and leave room on the {outline.length:g} x "
            f"{outline.width:g} m sensor, got {margin:g} m"
        )
    elif not spacing >= across:
        yield f"spacing must be at least the indenter's {across:g} m, got {spacing:g}"
    elif not _has_room(many, outline, margin, spacing):
        yield (
            f"{many} touches {spacing:g} m apart and {margin:g} m from the rim do "
            "not fit, or almost never; ask for fewer, or less spacing or margin"
        )


def _has_room(amount: int, outline: PlaneOutline, margin: float, spacing: float) -> bool:
    try:
        draw_positions(amount, outline, margin, spacing, np.random.default_rng(0))
    except ConfigurationError:
        return False
    return True
