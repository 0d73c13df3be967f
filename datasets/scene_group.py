"""One kind of scene in a recipe: how many, how bent, where touched, and drawing them."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.schema import MAX_TOUCHES
from eitskin.datasets.state import State
from eitskin.geometry import Bend, ConfigurationError, PlaneOutline
from eitskin.simulator import Cylinder, Scene, Touch

_INDENTER = 2.0 * Cylinder().radius
_SETS_AT_ONCE = 256
_TRIES = 100
_TOUCH_ONLY = ("touches", "force", "margin", "spacing", "positions", "repeats")


@dataclass(frozen=True, slots=True)
class SceneGroup:
    """Scenes of one kind; ranges are [lowest, highest], drawn from uniformly.

    Attributes:
        state: "idle", "bend" or "touch"; a touched sensor may be bent as well.
        count: how many frames; follows from `positions` where those are given.
        angle_deg: range of the bend angle.
        touches: range of how many touches at once, 1 to 4; one when omitted.
        force: range of the force of each touch [N].
        margin: least distance of a touch's centre from the rim [m].
        spacing: least distance between the centres of two touches [m].
        positions: places (x, y) [m] that are pressed one at a time, instead of random ones.
        repeats: how many frames for each of `positions`.
    """

    state: Literal["idle", "bend", "touch"]
    count: int = 0
    angle_deg: tuple[float, float] = (0.0, 0.0)
    touches: tuple[int, int] = (1, 1)
    force: tuple[float, float] = (10.0, 10.0)
    margin: float = 0.010
    spacing: float = 0.030
    positions: tuple[tuple[float, float], ...] = ()
    repeats: int = 1

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.positions) * self.repeats if self.positions else self.count

    @property
    def label(self) -> State:
        """What the frames are labelled with."""
        return State[self.state.upper()]

    def problems(self, outline: PlaneOutline) -> Iterator[str]:
        """Everything about the group that contradicts itself or the sensor's `outline`."""
        for name in ("angle_deg", "touches", "force"):
            low, high = getattr(self, name)
            if not (math.isfinite(low) and math.isfinite(high) and low <= high):
                yield f"{name} must be [lowest, highest], got [{low}, {high}]"
        if self.positions:
            yield from self._position_problems(outline)
        elif self.count < 1:
            yield f"count must be at least 1, got {self.count}"
        elif self.repeats != 1:
            yield "repeats goes with positions; give positions, or count alone"
        if self.state == "touch":
            yield from self._touch_problems(outline)
        else:
            defaults = {field.name: field.default for field in fields(self)}
            given = [name for name in _TOUCH_ONLY if getattr(self, name) != defaults[name]]
            if given:
                yield f"state '{self.state}' has no touches, so leave out {', '.join(given)}"
        if self.state == "idle" and self.angle_deg != (0.0, 0.0):
            yield 'an idle sensor is flat: leave out angle_deg, or say state = "bend"'
        if self.state == "bend" and self.angle_deg == (0.0, 0.0):
            yield "state 'bend' needs a range of angle_deg other than [0, 0]"

    def draw(self, number: int, outline: PlaneOutline, rng: np.random.Generator) -> Scene:
        """Scene `number` of the group, of what `rng` gives."""
        bend = Bend(float(rng.uniform(*self.angle_deg)))
        if self.state != "touch":
            return Scene(bend=bend)
        if self.positions:
            places = np.array([self.positions[number % len(self.positions)]])
        else:
            amount = int(rng.integers(self.touches[0], self.touches[1], endpoint=True))
            places = draw_places(amount, outline, self.margin, self.spacing, rng)
        forces = rng.uniform(*self.force, size=len(places))
        return Scene(
            bend=bend,
            touches=tuple(
                Touch(float(x), float(y), float(force))
                for (x, y), force in zip(places, forces, strict=True)
            ),
        )

    def _position_problems(self, outline: PlaneOutline) -> Iterator[str]:
        if self.count:
            yield "count follows from positions and repeats; leave it out"
        if self.repeats < 1:
            yield f"repeats must be at least 1, got {self.repeats}"
        for x, y in self.positions:
            if not outline.contains(np.array([x, y])):
                yield (
                    f"position ({x:g}, {y:g}) m is off the {outline.length:g} x "
                    f"{outline.width:g} m sensor; are the units metres?"
                )

    def _touch_problems(self, outline: PlaneOutline) -> Iterator[str]:
        few, many = self.touches
        if not 0.0 < self.force[0] <= self.force[1]:
            yield f"force must be a rising range above 0 N, got {list(self.force)}"
        if not 1 <= few <= many <= MAX_TOUCHES:
            yield f"touches must be from 1 to {MAX_TOUCHES}, got {list(self.touches)}"
        elif self.positions and self.touches != (1, 1):
            yield "positions are pressed one at a time; leave out touches"
        elif not (self.margin >= 0.0 and 2.0 * self.margin < min(outline.length, outline.width)):
            yield (
                f"margin must be at least 0 and leave room on the {outline.length:g} x "
                f"{outline.width:g} m sensor, got {self.margin:g} m"
            )
        elif not self.spacing >= _INDENTER:
            yield f"spacing must be at least the indenter's {_INDENTER:g} m, got {self.spacing:g}"
        elif not self._has_room(many, outline):
            yield (
                f"{many} touches {self.spacing:g} m apart and {self.margin:g} m from the rim do "
                "not fit, or almost never; ask for fewer, or less spacing or margin"
            )

    def _has_room(self, amount: int, outline: PlaneOutline) -> bool:
        try:
            draw_places(amount, outline, self.margin, self.spacing, np.random.default_rng(0))
        except ConfigurationError:
            return False
        return True


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
