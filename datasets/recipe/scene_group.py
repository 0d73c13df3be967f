"""Groups of scenes in a recipe: number, bend angles, touches, and their random draws and checks."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from eitskin.bounds import sample_uniform
from eitskin.datasets.store.schema import MAX_TOUCHES, State
from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Bend, Roll
from eitskin.geometry.design.outline import PlaneOutline
from eitskin.geometry.design.sensor import Support
from eitskin.simulator.scene.indenters import Cylinder, Footprint, Indenter, Profile, Sphere
from eitskin.simulator.scene.scene import Scene, Touch

_SETS_AT_ONCE = 16
_TRIES = 1600
_TOUCH_ONLY = (
    "touches",
    "force",
    "margin",
    "spacing",
    "from_middle",
    "positions",
    "repeats",
    "indenter",
)


@dataclass(frozen=True, slots=True)
class SceneGroup:
    """Group of similar scenes; ranges are [lowest, highest] of uniform distributions.

    Attributes:
        state: state of the sensor; a touched one may be bent as well.
        count: number of frames; follows from `positions` where those are given.
        angle_deg: range of the bend angle.
        touches: range of the number of simultaneous touches, 1 to 4.
        force: range of the force of each touch [N].
        margin: minimum distance of a touch's centre from the rim [m].
        spacing: minimum distance between the centres of two touches [m].
        from_middle: range of the distance of touches from the sensor's middle along x [m].
        positions: list of (x, y) of single touches [m], instead of random positions.
        repeats: number of frames for each of `positions`.
        per_bend: number of consecutive frames with one angle, whose untouched frame is solved once.
        support: support of the sensor in these scenes; the design's when omitted.
        roll_deg: range of the roll across the width.
        indenter: shape of all touches; the default cylinder when omitted.
    """

    state: Literal["idle", "bend", "touch"]
    count: int = 0
    angle_deg: tuple[float, float] = (0.0, 0.0)
    touches: tuple[int, int] = (1, 1)
    force: tuple[float, float] = (10.0, 10.0)
    margin: float = 0.010
    spacing: float = 0.030
    from_middle: tuple[float, float] | None = None
    positions: tuple[tuple[float, float], ...] = ()
    repeats: int = 1
    per_bend: int = 1
    support: Support | None = None
    roll_deg: tuple[float, float] | None = None
    indenter: Cylinder | Sphere | Profile | Footprint | None = None

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
            if problem := range_problem(name, getattr(self, name) or (0.0, 0.0)):
                yield problem
        if self.positions:
            yield from self._position_problems(outline)
        else:
            yield from count_problems("count", self.count)
            if self.repeats != 1:
                yield "repeats goes with positions; give positions, or count alone"
        yield from count_problems("per_bend", self.per_bend)
        if self.state == "touch":
            yield from touch_problems(
                self.force,
                self.touches,
                self.margin,
                self.spacing,
                outline,
                self.touch_indenter,
                self.from_middle,
            )
        else:
            plain = SceneGroup(self.state)
            fields = [each for each in _TOUCH_ONLY if getattr(self, each) != getattr(plain, each)]
            if fields:
                yield f"state '{self.state}' has no touches, so leave out {', '.join(fields)}"
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
    def touch_indenter(self) -> Cylinder | Sphere | Profile | Footprint:
        """Indenter of all touches."""
        return self.indenter or Cylinder()

    def draw_untouched(self, rng: np.random.Generator) -> Scene:
        """Random bend and roll of one block of frames."""
        bend = Bend(float(sample_uniform(rng, self.angle_deg)))
        roll = (
            Roll(float(sample_uniform(rng, self.roll_deg)))
            if self.roll_deg and self.rolls
            else None
        )
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
            positions = draw_positions(
                amount, outline, self.margin, self.spacing, rng, self.from_middle
            )
        forces = sample_uniform(rng, self.force, len(positions))
        touches = tuple(
            Touch(float(x), float(y), float(force), self.touch_indenter)
            for (x, y), force in zip(positions, forces, strict=True)
        )
        return replace(untouched, touches=touches)

    def _position_problems(self, outline: PlaneOutline) -> Iterator[str]:
        if self.count:
            yield "count follows from positions and repeats; leave it out"
        yield from count_problems("repeats", self.repeats)
        if self.touches != (1, 1):
            yield "positions are pressed one at a time; leave out touches"
        if self.from_middle is not None:
            yield "from_middle is for random positions; leave it or positions out"
        yield from position_problems(self.positions, outline)


def draw_positions(
    amount: int,
    outline: PlaneOutline,
    margin: float,
    spacing: float,
    rng: np.random.Generator,
    from_middle: tuple[float, float] | None = None,
) -> NDArray[np.float64]:
    """Random positions (amount, 2) [m], uniform over all sets with the given distances [m].

    Rejection sampling of whole sets: placing one touch after another would favour the rim. Raises
    ConfigurationError where no set of many has these distances.
    """
    low = np.array([margin, margin])
    high = np.array([outline.length, outline.width]) - margin
    first, second = np.triu_indices(amount, k=1)
    for _ in range(_TRIES):
        sets = rng.uniform(low, high, size=(_SETS_AT_ONCE, amount, 2))
        apart = np.linalg.norm(sets[:, first] - sets[:, second], axis=-1)
        good = (apart >= spacing).all(axis=1)
        if from_middle is not None:
            away = np.abs(sets[..., 0] - 0.5 * outline.length)
            good &= ((from_middle[0] <= away) & (away <= from_middle[1])).all(axis=1)
        positions: NDArray[np.float64]
        for positions in sets[good]:
            if outline.contains(positions, margin).all():
                return positions
    raise ConfigurationError(
        f"could not place {amount} touches {spacing:g} m apart and {margin:g} m from the rim; ask "
        "for fewer touches, or less spacing or margin"
    )


def refusal(check: Callable[[], object], subject: str = "") -> Iterator[str]:
    """Sentence, after its subject, with which a check refuses what it is given; none else."""
    try:
        check()
    except ConfigurationError as error:
        yield f"{subject}{error}"


def count_problems(name: str, value: int, least: int = 1, most: int | None = None) -> Iterator[str]:
    """Sentence on a number that is below `least`, or above `most` where that is given."""
    if value < least or (most is not None and value > most):
        limits = f"at least {least}" if most is None else f"from {least} to {most}"
        yield f"{name} must be {limits}, got {value}"


def range_problem(name: str, limits: tuple[float, float], above: float = -math.inf) -> str:
    """Reason why limits are no range of numbers above a bound; empty without one."""
    low, high = limits
    if above < low <= high and math.isfinite(low) and math.isfinite(high):
        return ""
    where = "" if above == -math.inf else f", above {above:g}"
    return f"{name} must be a rising range [lowest, highest]{where}, got [{low}, {high}]"


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
    from_middle: tuple[float, float] | None = None,
) -> Iterator[str]:
    """Reasons why touches in these ranges cannot be drawn, a sentence each; see `SceneGroup`."""
    few, many = touches
    rng = np.random.default_rng(0)
    across = 2.0 * float(indenter.reach(np.concatenate([np.eye(2), -np.eye(2)])).max())
    if problem := range_problem("force", force, above=0.0):
        yield problem
    if from_middle is not None and (problem := range_problem("from_middle", from_middle)):
        yield problem
    if not 1 <= few <= many <= MAX_TOUCHES:
        yield f"touches must be from 1 to {MAX_TOUCHES}, got {list(touches)}"
    elif not (margin >= 0.0 and 2.0 * margin < min(outline.length, outline.width)):
        yield (
            f"margin must be at least 0 and leave room on the {outline.length:g} x "
            f"{outline.width:g} m sensor, got {margin:g} m"
        )
    elif not spacing >= across:
        yield f"spacing must be at least the indenter's {across:g} m, got {spacing:g}"
    elif any(refusal(lambda: draw_positions(many, outline, margin, spacing, rng, from_middle))):
        yield (
            f"{many} touches {spacing:g} m apart and {margin:g} m from the rim do "
            "not fit, or almost never; ask for fewer, or less spacing or margin"
            + ", or another from_middle"
            * (from_middle is not None)
        )
