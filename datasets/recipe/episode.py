"""Episodes: time series of the bend angle and of touches, scripted or random."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from eitskin.bounds import sample_uniform
from eitskin.datasets.recipe.scene_group import (
    count_problems,
    draw_positions,
    position_problems,
    range_problem,
    touch_problems,
)
from eitskin.datasets.store.schema import LIMITS, MAX_TOUCHES
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.geometry.design.outline import PlaneOutline
from eitskin.simulator.mechanics.touch_history import HeldTouch, held_touches, recall_touches
from eitskin.simulator.mechanics.viscoelasticity import Prony
from eitskin.simulator.scene.indenters import Cylinder
from eitskin.simulator.scene.scene import Scene, Touch

PERIOD = 0.297
"""Time from one frame to the next [s]: 28 measurements of 10.6 ms."""

MAX_PERIOD = 86400.0
"""Longest time from one frame to the next [s]."""

_ENDLESS = 1e18  # frames, more than any recipe may have


@dataclass(frozen=True, slots=True)
class EpisodeTouch:
    """Touch of an episode: x, y [m] and force [N]."""

    x: float
    y: float
    force: float = 10.0


@dataclass(frozen=True, slots=True)
class Timeline:
    """Bend angle and touches of one episode as functions of time.

    Attributes:
        times: times of the knots of the angle, rising [s].
        angles_deg: angles at the knots; linear between knots, constant beyond.
        touches: touches in any order.
    """

    times: tuple[float, ...]
    angles_deg: tuple[float, ...]
    touches: tuple[HeldTouch, ...] = ()

    def scene(self, time: float, relaxation: Prony | None = None) -> Scene:
        """Scene at a time [s]; touches creep, and recover after release, by `relaxation` if given.

        Held touches come first. A released touch is dropped when its residual force is below a
        thousandth of its force.
        """
        bend = Bend(float(np.interp(time, self.times, self.angles_deg)))
        return Scene(bend, recall_touches(self.touches, time, relaxation))


@dataclass(frozen=True, slots=True)
class Keyframe:
    """Keyframe of a scripted episode.

    Attributes:
        time: time since the episode's start [s].
        angle_deg: angle of the bend; linear to the next keyframe's.
        touches: touches that begin now and are held until the next keyframe, or longer where that
            lists the same touch.
    """

    time: float
    angle_deg: float = 0.0
    touches: tuple[EpisodeTouch, ...] = ()


@dataclass(frozen=True, slots=True)
class ScriptedEpisode:
    """Scripted episode: keyframes, of which the last one ends the episode.

    Attributes:
        keyframes: rising in time from 0.
        repeats: number of passes through the keyframes within an episode.
        count: number of such episodes, which differ in specimen and noise.
        period: time from one frame to the next [s].
        relaxation: whether touches creep while held and recover slowly after release.
    """

    keyframes: tuple[Keyframe, ...]
    repeats: int = 1
    count: int = 1
    period: float = PERIOD
    relaxation: bool = True

    @property
    def frames(self) -> int:
        """Number of frames of one episode; one beyond all bounds has more than any recipe may."""
        if not self.period > 0.0:
            return int(_ENDLESS)
        passed = self.repeats * self.keyframes[-1].time / self.period
        return max(1, math.ceil(min(passed, _ENDLESS) - 1e-9))

    @property
    def angles_deg(self) -> tuple[float, float]:
        """Lowest and highest angle."""
        angles = [keyframe.angle_deg for keyframe in self.keyframes]
        return min(angles), max(angles)

    @property
    def largest_force(self) -> float:
        """Largest force of any touch [N]; 0 without touches."""
        return max((p.force for k in self.keyframes for p in k.touches), default=0.0)

    def problems(self, outline: PlaneOutline) -> Iterator[str]:
        """Contradictions within the episode, or with the sensor's `outline`, a sentence each."""
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
            positions = tuple((touch.x, touch.y) for touch in keyframe.touches)
            yield from position_problems(positions, outline)
            if any(not touch.force > 0.0 for touch in keyframe.touches):
                yield f"keyframes[{number}] has a force that is not above 0 N"

    def draw(self, outline: PlaneOutline, rng: np.random.Generator) -> Timeline:  # noqa: ARG002
        """Timeline of the script; draws nothing from `rng`."""
        length = self.keyframes[-1].time
        script = [
            (turn * length + keyframe.time, keyframe)
            for turn in range(self.repeats)
            for keyframe in self.keyframes[: None if turn == self.repeats - 1 else -1]
        ]
        return Timeline(
            tuple(time for time, _ in script),
            tuple(keyframe.angle_deg for _, keyframe in script),
            tuple(
                held_touches(
                    (time, [Touch(t.x, t.y, t.force) for t in keyframe.touches])
                    for time, keyframe in [*script[:-1], (script[-1][0], Keyframe(0.0))]
                )
            ),
        )


@dataclass(frozen=True, slots=True)
class RandomEpisodes:
    """Random episodes; ranges are [lowest, highest] of uniform distributions.

    The sensor starts flat and untouched. The bend rests, moves to a random angle at a random speed,
    and rests again; independently of it, pauses alternate with one or more touches.

    Attributes:
        count: number of episodes.
        frames: number of frames in each episode.
        angle_deg: range of the bend angle.
        speed_deg_s: range of the bend's speed while moving [deg/s].
        rest_s: range of the time between two moves [s].
        pause_s: range of the time without touches between two holds [s].
        hold_s: range of the time that touches are held [s].
        touches: range of the number of simultaneous touches, 1 to 4.
        force: range of the force of each touch [N].
        margin: minimum distance of a touch's centre from the rim [m].
        spacing: minimum distance between the centres of two touches [m].
        period: time from one frame to the next [s].
        relaxation: whether touches creep while held and recover slowly after release.
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
        """Largest force of any touch [N]."""
        return self.force[1]

    def problems(self, outline: PlaneOutline) -> Iterator[str]:
        """Contradictions within the episodes, or with the sensor's `outline`, a sentence each."""
        yield from _count_problems(self.count, self.period)
        yield from count_problems("frames", self.frames, 1, LIMITS["frame"])
        for name in ("angle_deg", "speed_deg_s", "rest_s", "pause_s", "hold_s"):
            above = -math.inf if name == "angle_deg" else 0.0
            if problem := range_problem(name, getattr(self, name), above):
                yield problem
        yield from touch_problems(
            self.force, self.touches, self.margin, self.spacing, outline, Cylinder()
        )

    def draw(self, outline: PlaneOutline, rng: np.random.Generator) -> Timeline:
        """Random timeline, drawn from `rng`."""
        moves, touches = rng.spawn(2)
        end = self.frames * self.period
        times, angles = [0.0], [0.0]
        while times[-1] < end:
            pause, angle = sample_uniform(moves, self.rest_s), sample_uniform(moves, self.angle_deg)
            lasts = abs(angle - angles[-1]) / sample_uniform(moves, self.speed_deg_s)
            times += [times[-1] + pause, times[-1] + pause + lasts]
            angles += [angles[-1], angle]
        return Timeline(tuple(times), tuple(angles), tuple(self._touches(outline, touches)))

    def _touches(self, outline: PlaneOutline, rng: np.random.Generator) -> Iterator[HeldTouch]:
        time = sample_uniform(rng, self.pause_s)
        while time < self.frames * self.period:
            amount = int(rng.integers(*self.touches, endpoint=True))
            positions = draw_positions(amount, outline, self.margin, self.spacing, rng).tolist()
            end = time + sample_uniform(rng, self.hold_s)
            for x, y in positions:
                yield HeldTouch(Touch(x, y, sample_uniform(rng, self.force)), time, end)
            time = end + sample_uniform(rng, self.pause_s)


Episodes = ScriptedEpisode | RandomEpisodes


def _count_problems(count: int, period: float) -> Iterator[str]:
    yield from count_problems("count", count)
    if not 0.0 < period <= MAX_PERIOD:
        yield f"period must be a time above 0 s and at most {MAX_PERIOD:g} s, got {period}"
