"""Time series: how the bend moves and when presses come and go."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from eitskin.datasets.recipe.touch_sampling import draw_places, place_problems, touch_problems
from eitskin.datasets.store.schema import LIMITS, MAX_TOUCHES
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.geometry.design.outline import PlaneOutline
from eitskin.simulator.mechanics.viscoelasticity import Prony, elastic_force
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.scene.touch import Touch

PERIOD = 0.297
"""From one frame to the next: 28 measurements of 10.6 ms [s]."""

_FORGOTTEN = 1e-3  # of its force, below which what a press has left behind is let go
_JUST = 1e-9  # s; a press that ends at this moment is over


@dataclass(frozen=True, slots=True)
class EpisodeTouch:
    """Where and how hard the sensor is pressed: place [m] and force [N]."""

    x: float
    y: float
    force: float = 10.0


@dataclass(frozen=True, slots=True)
class Held:
    """A press from `start` until `end` [s]."""

    press: EpisodeTouch
    start: float
    end: float


@dataclass(frozen=True, slots=True)
class Timeline:
    """What happens to a sensor in one episode.

    Attributes:
        times: of the knots of the angle, rising [s].
        angles_deg: at the knots; straight between them, constant beyond.
        presses: in any order.
    """

    times: tuple[float, ...]
    angles_deg: tuple[float, ...]
    presses: tuple[Held, ...] = ()

    def scene(self, time: float, memory: Prony | None = None) -> Scene:
        """The scene at a time [s]; presses creep and linger by `memory`, where there is one.

        The presses that act come first. What those that are over have left is dropped when it is
        less than a thousandth of what they were.
        """
        acting = [each for each in self.presses if each.start <= time < each.end]
        touches = [_touch(each, time - each.start if memory else None) for each in acting]
        if memory:
            for each in self.presses:
                lasted, released = each.end - each.start, max(time - each.end, _JUST)
                if each.end <= time and elastic_force(memory, 1.0, lasted, released) > _FORGOTTEN:
                    touches.append(_touch(each, lasted, released))
        bend = Bend(float(np.interp(time, self.times, self.angles_deg)))
        return Scene(bend, tuple(touches))


def _touch(each: Held, lasted: float | None, released: float = 0.0) -> Touch:
    press = each.press
    return Touch(press.x, press.y, press.force, held=lasted, released=released)


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A moment of a script.

    Attributes:
        time: since the script began [s].
        angle_deg: of the bend; straight to the next keyframe's.
        touches: that are set on now and stay until the next keyframe, or longer where it has them
            too.
    """

    time: float
    angle_deg: float = 0.0
    touches: tuple[EpisodeTouch, ...] = ()


@dataclass(frozen=True, slots=True)
class ScriptedEpisode:
    """An episode that is told in full. It ends with the last keyframe.

    Attributes:
        keyframes: rising in time from 0.
        repeats: how many times they follow each other within an episode.
        count: how many such episodes, which differ in specimen and noise.
        period: from one frame to the next [s].
        relaxation: whether presses creep while they are held and linger afterwards.
    """

    keyframes: tuple[Keyframe, ...]
    repeats: int = 1
    count: int = 1
    period: float = PERIOD
    relaxation: bool = True

    @property
    def frames(self) -> int:
        """Number of frames of one episode."""
        return max(1, math.ceil(self.repeats * self.keyframes[-1].time / self.period - 1e-9))

    @property
    def angles_deg(self) -> tuple[float, float]:
        """Lowest and highest angle."""
        angles = [keyframe.angle_deg for keyframe in self.keyframes]
        return min(angles), max(angles)

    @property
    def largest_force(self) -> float:
        """Of any press [N]; 0 without one."""
        return max((p.force for k in self.keyframes for p in k.touches), default=0.0)

    def problems(self, outline: PlaneOutline) -> Iterator[str]:
        """Everything about the episode that contradicts itself or the sensor's `outline`."""
        yield from _count_problems(self.count, self.period)
        times = [keyframe.time for keyframe in self.keyframes]
        if len(times) < 2 or times[0] != 0.0 or any(b <= a for a, b in pairwise(times)):
            yield f"keyframes must be at least two, rising in time from 0 s, got times {times}"
            return
        if not 1 <= self.repeats * self.frames <= LIMITS["frame"]:
            yield f"repeats must be at least 1, and few enough to be kept, got {self.repeats}"
        for number, keyframe in enumerate(self.keyframes):
            if len(keyframe.touches) > MAX_TOUCHES:
                yield f"keyframes[{number}] may have {MAX_TOUCHES} touches, not more"
            places = tuple((press.x, press.y) for press in keyframe.touches)
            yield from place_problems(places, outline)
            if any(not press.force > 0.0 for press in keyframe.touches):
                yield f"keyframes[{number}] has a force that is not above 0 N"

    def draw(self, outline: PlaneOutline, rng: np.random.Generator) -> Timeline:  # noqa: ARG002
        """What happens; nothing here is left to chance."""
        length = self.keyframes[-1].time
        told = [
            (turn * length + keyframe.time, keyframe)
            for turn in range(self.repeats)
            for keyframe in self.keyframes[: None if turn == self.repeats - 1 else -1]
        ]
        return Timeline(
            tuple(time for time, _ in told),
            tuple(keyframe.angle_deg for _, keyframe in told),
            tuple(_joined(told)),
        )


def _joined(told: list[tuple[float, Keyframe]]) -> Iterator[Held]:
    """The presses of keyframes at their times; one that stays for several is one press."""
    begun: dict[EpisodeTouch, float] = {}
    for time, keyframe in [*told[:-1], (told[-1][0], Keyframe(0.0))]:
        for press in [press for press in begun if press not in keyframe.touches]:
            yield Held(press, begun.pop(press), time)
        for press in keyframe.touches:
            begun.setdefault(press, time)


@dataclass(frozen=True, slots=True)
class RandomEpisodes:
    """Episodes of chance; ranges are [lowest, highest], drawn from uniformly.

    The sensor starts flat and untouched. It rests, moves to an angle at a speed, rests again; and
    independently of that it is left alone, then touched at some places at once.

    Attributes:
        count: how many episodes.
        frames: of each.
        angle_deg: of the bends.
        speed_deg_s: of the bend while it moves [deg/s].
        rest_s: between two moves [s].
        pause_s: without touches between two presses [s].
        hold_s: duration of a press [s].
        touches: how many at once, 1 to 4.
        force: of each touch [N].
        margin, spacing: of the touches, as of a group of scenes [m].
        period: from one frame to the next [s].
        relaxation: whether presses creep while they are held and linger afterwards.
    """

    count: int
    frames: int
    angle_deg: tuple[float, float] = (0.0, 0.0)
    speed_deg_s: tuple[float, float] = (5.0, 30.0)
    rest_s: tuple[float, float] = (2.0, 10.0)
    pause_s: tuple[float, float] = (2.0, 10.0)
    hold_s: tuple[float, float] = (1.0, 5.0)
    touches: tuple[int, int] = (1, 1)
    force: tuple[float, float] = (10.0, 10.0)
    margin: float = 0.010
    spacing: float = 0.030
    period: float = PERIOD
    relaxation: bool = True

    @property
    def angles_deg(self) -> tuple[float, float]:
        """Lowest and highest angle."""
        return min(0.0, self.angle_deg[0]), max(0.0, self.angle_deg[1])

    @property
    def largest_force(self) -> float:
        """Of any press [N]."""
        return self.force[1]

    def problems(self, outline: PlaneOutline) -> Iterator[str]:
        """Everything about the episodes that contradicts itself or the sensor's `outline`."""
        yield from _count_problems(self.count, self.period)
        if not 1 <= self.frames <= LIMITS["frame"]:
            yield f"frames must be from 1 to {LIMITS['frame']}, got {self.frames}"
        low, high = self.angle_deg
        if not low <= high:
            yield f"angle_deg must be [lowest, highest], got [{low}, {high}]"
        for name in ("speed_deg_s", "rest_s", "pause_s", "hold_s"):
            low, high = getattr(self, name)
            if not 0.0 < low <= high:
                yield f"{name} must be a rising range above 0, got [{low}, {high}]"
        yield from touch_problems(self.force, self.touches, self.margin, self.spacing, outline)

    def draw(self, outline: PlaneOutline, rng: np.random.Generator) -> Timeline:
        """What happens, of what `rng` gives."""
        moves, presses = rng.spawn(2)
        end = self.frames * self.period
        times, angles = [0.0], [0.0]
        while times[-1] < end:
            rest, angle = moves.uniform(*self.rest_s), moves.uniform(*self.angle_deg)
            lasts = abs(angle - angles[-1]) / moves.uniform(*self.speed_deg_s)
            times += [times[-1] + rest, times[-1] + rest + lasts]
            angles += [angles[-1], angle]
        return Timeline(tuple(times), tuple(angles), tuple(self._presses(outline, presses)))

    def _presses(self, outline: PlaneOutline, rng: np.random.Generator) -> Iterator[Held]:
        time = rng.uniform(*self.pause_s)
        while time < self.frames * self.period:
            amount = int(rng.integers(*self.touches, endpoint=True))
            places = draw_places(amount, outline, self.margin, self.spacing, rng).tolist()
            end = time + rng.uniform(*self.hold_s)
            for x, y in places:
                yield Held(EpisodeTouch(x, y, rng.uniform(*self.force)), time, end)
            time = end + rng.uniform(*self.pause_s)


Episodes = ScriptedEpisode | RandomEpisodes


def _count_problems(count: int, period: float) -> Iterator[str]:
    if count < 1:
        yield f"count must be at least 1, got {count}"
    if not (math.isfinite(period) and period > 0.0):
        yield f"period must be a time above 0 s, got {period}"
