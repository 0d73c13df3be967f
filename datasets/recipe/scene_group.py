"""Groups of scenes in a recipe: number, bend angles, touches, and their random draws."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from eitskin.bounds import drawn
from eitskin.datasets.recipe.touch_sampling import draw_positions, position_problems, touch_problems
from eitskin.datasets.store.schema import State
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.geometry.deformation.flexure import Roll
from eitskin.geometry.design.outline import PlaneOutline
from eitskin.geometry.design.sensor import Support
from eitskin.simulator.scene.indenters import Cylinder, Profile, Sphere
from eitskin.simulator.scene.scene import Scene, Touch

_TOUCH_ONLY = ("touches", "force", "margin", "spacing", "positions", "repeats", "indenter")


@dataclass(frozen=True, slots=True)
class SceneGroup:
    """Group of similar scenes; ranges are [lowest, highest] of uniform distributions.

    Attributes:
        state: "idle", "bend" or "touch"; a touched sensor may be bent as well.
        count: number of frames; follows from `positions` where those are given.
        angle_deg: range of the bend angle.
        touches: range of the number of simultaneous touches, 1 to 4; one when omitted.
        force: range of the force of each touch [N].
        margin: least distance of a touch's centre from the rim [m].
        spacing: least distance between the centres of two touches [m].
        positions: (x, y) [m] of single touches in turn, instead of random positions.
        repeats: number of frames for each of `positions`.
        per_bend: number of consecutive frames with one angle, whose untouched frame is solved once.
        support: of the sensor in these scenes; the design's when omitted.
        roll_deg: range of the roll across the width, about the other axis than the bend; none when
            omitted.
        indenter: of all touches, a cylinder, ball or profile; the default one when omitted.
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
    per_bend: int = 1
    support: Support | None = None
    roll_deg: tuple[float, float] | None = None
    indenter: Cylinder | Sphere | Profile | None = None

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.positions) * self.repeats if self.positions else self.count

    @property
    def label(self) -> State:
        """State that labels the frames."""
        return State[self.state.upper()]

    def problems(self, outline: PlaneOutline) -> Iterator[str]:
        """Contradictions within the group, or with the sensor's `outline`, a sentence each."""
        for name in ("angle_deg", "roll_deg", "touches", "force"):
            low, high = getattr(self, name) or (0.0, 0.0)
            if not (math.isfinite(low) and math.isfinite(high) and low <= high):
                yield f"{name} must be [lowest, highest], got [{low}, {high}]"
        if self.positions:
            yield from self._position_problems(outline)
        elif self.count < 1:
            yield f"count must be at least 1, got {self.count}"
        elif self.repeats != 1:
            yield "repeats goes with positions; give positions, or count alone"
        if self.per_bend < 1:
            yield f"per_bend must be at least 1, got {self.per_bend}"
        if self.state == "touch":
            yield from touch_problems(
                self.force, self.touches, self.margin, self.spacing, outline, self.pressed_by
            )
        else:
            plain = SceneGroup(self.state)
            given = [each for each in _TOUCH_ONLY if getattr(self, each) != getattr(plain, each)]
            if given:
                yield f"state '{self.state}' has no touches, so leave out {', '.join(given)}"
        if self.state == "idle" and self.bends:
            yield 'an idle sensor is flat: leave out angle_deg and roll_deg, or say state = "bend"'
        if self.state == "bend" and not self.bends:
            yield "state 'bend' needs a range of angle_deg or roll_deg other than [0, 0]"

    @property
    def blocks(self) -> int:
        """Number of blocks of consecutive frames with one angle."""
        return -(-self.frames // self.per_bend)

    @property
    def bends(self) -> bool:
        """Whether the sensor is bent or rolled in these scenes."""
        return self.angle_deg != (0.0, 0.0) or self.rolls

    @property
    def rolls(self) -> bool:
        """Whether the sensor is rolled in these scenes."""
        return self.roll_deg not in (None, (0.0, 0.0))

    @property
    def pressed_by(self) -> Cylinder | Sphere | Profile:
        """Indenter of all touches."""
        return self.indenter or Cylinder()

    def draw_untouched(self, rng: np.random.Generator) -> Scene:
        """Random bend and roll of one block of frames."""
        bend = Bend(float(drawn(rng, self.angle_deg)))
        roll = Roll(float(drawn(rng, self.roll_deg))) if self.roll_deg and self.rolls else None
        return Scene(bend=bend, roll=roll, support=self.support)

    def draw(
        self, number: int, untouched: Scene, outline: PlaneOutline, rng: np.random.Generator
    ) -> Scene:
        """Scene `number` of the group: the untouched one, with touches drawn from `rng`."""
        if self.state != "touch":
            return untouched
        if self.positions:
            positions = np.array([self.positions[number % len(self.positions)]])
        else:
            amount = int(rng.integers(self.touches[0], self.touches[1], endpoint=True))
            positions = draw_positions(amount, outline, self.margin, self.spacing, rng)
        forces = drawn(rng, self.force, len(positions))
        touches = tuple(
            Touch(float(x), float(y), float(force), self.pressed_by)
            for (x, y), force in zip(positions, forces, strict=True)
        )
        return replace(untouched, touches=touches)

    def _position_problems(self, outline: PlaneOutline) -> Iterator[str]:
        if self.count:
            yield "count follows from positions and repeats; leave it out"
        if self.repeats < 1:
            yield f"repeats must be at least 1, got {self.repeats}"
        if self.touches != (1, 1):
            yield "positions are pressed one at a time; leave out touches"
        yield from position_problems(self.positions, outline)
