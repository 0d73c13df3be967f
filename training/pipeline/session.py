"""Session of a pipeline: references, the frames of a held touch, and doubts about both."""

from collections import deque
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import UnusableFrameError
from eitskin.frame import Frame
from eitskin.training.method.input_spec import require_usable
from eitskin.training.method.observations import Observations, relative_difference
from eitskin.training.method.predictions import Predictions, Zero
from eitskin.training.method.sensor_health import ReadingRange, SensorHealth
from eitskin.training.pipeline.held_touch import MAX_HELD_FRAMES, EarlierTouches, HeldTouch, Phases
from eitskin.training.pipeline.references import (
    MAX_GAP,
    MAX_MEAN_FRAMES,
    RunningMean,
    SessionOrder,
    StoredReference,
    Voltages,
)

# of the median magnitude; smaller values may change their sign by a touch
SMALL_MAGNITUDE_SHARE = 0.1
MIN_GAIN_STEP, MAX_GAIN_STEP = 2e-4, 0.2  # of all channels alike, from frame to frame
COMMON = 0.3  # spread of the channels over their mean, below which they change alike at most
MIN_EARLIER = 2  # frames of the untouched sensor that an onset is reported from
# probability of a touch from which a frame does not renew the references
SUSPICION_PROBABILITY = 1e-3
STORED_AGE = 24 * 3600.0  # s; assumed age of a stored reference when a session begins
START_REMEDY = (
    "angle, idle and bend are unknown; straighten and release it and begin again, or use its "
    "stored reference (eitskin tare, --reference)"
)


class Earlier(NamedTuple):
    """Frame of the untouched sensor, and the references before it."""

    voltages: Voltages
    static: RunningMean
    dynamic: RunningMean


@dataclass
class Session:
    """References of consecutive frames of one sensor, and the memory of a held touch.

    `static` is of the flat, untouched sensor, averaged while it is still at the session's start.
    `dynamic` follows the sensor while nothing touches it, averaged while the sensor is still, and
    is frozen during a touch. Both begin with the stored reference where one is in use, and the
    static one stays that.

    Attributes:
        noise: rms relative difference of two frames of a still sensor.
        averages: whether frames of a held touch are averaged.
        stored: stored reference, the zero of all estimates; None where the first frames are.
        bends: whether the sensor is one that bends, so that its dynamic reference gets out of date.
        noise_scale: noise that the method weighs frames by, relative to `noise`.
        common: spread of the channels over their mean below which a step is not of the sensor.
        usual: range of the readings of a healthy sensor; None where it is not known.
        static, dynamic: references.
        touched: whether the latest frame was touched.
        doubt: reason why the first frame is not that of a flat, untouched sensor; empty without.
    """

    noise: float
    averages: bool = False
    stored: StoredReference | None = None
    bends: bool = True
    noise_scale: float = 1.0
    common: float = COMMON
    usual: ReadingRange | None = None

    def __post_init__(self) -> None:
        """A session that waits for its first frame."""
        self._order = SessionOrder()
        self.begin()

    def begin(self) -> None:
        """Forget all but the stored reference and the frames' order."""
        self.static, self.dynamic = RunningMean(self.noise), RunningMean(self.noise)
        if self.stored is not None:
            count = min(self.stored.frames, MAX_MEAN_FRAMES)
            self.static, self.dynamic = (
                RunningMean(self.noise, self.stored.impedance, count) for _ in range(2)
            )
        self._held = HeldTouch(self.noise, self.noise_scale)
        self._opening = self.stored is None
        self._earlier: deque[Earlier] = deque(maxlen=MAX_HELD_FRAMES)
        self._phases, self._turned = Phases(), np.zeros(0)
        self._onset, self._frames, self._lingers = 1, 1, False
        self._places, self._touches = np.zeros((0, 2)), EarlierTouches()
        self.touched, self._suspected, self._outdated, self.doubt = False, False, False, ""
        self._age_at_start = 0.0 if self.stored is None else STORED_AGE
        self._renewed = -self._age_at_start
        self._reversed = np.zeros(0, np.intp)
        self._health: SensorHealth | None = None
        self._gain, self._latest = 1.0 + 0.0j, np.zeros(0, np.complex128)

    @property
    def bend(self) -> Voltages:
        """Static reference (measurements,) [ohm], NaN where never measured; size 0 at first."""
        return self.static.mean

    @property
    def touch(self) -> Voltages:
        """Dynamic reference (measurements,) [ohm], NaN where never measured; size 0 at first."""
        return self.dynamic.mean

    @property
    def empty(self) -> bool:
        """Whether there is no reference yet."""
        return not self.touch.size

    @property
    def zero(self) -> Zero:
        """State of the sensor that estimates are relative to."""
        return Zero.FIRST_FRAMES if self.stored is None else self.stored.zero

    def follow(self, frame: Frame) -> tuple[str, ...]:
        """Take the next frame's session, number and time; begin again where they say so.

        Returns faults of number and time, and the beginning of a session, in words.
        """
        step = self._order.follow(frame)
        if step.new_session:
            self.begin()
        self._outdated = self._outdated or step.gap
        return step.problems

    def average(self, voltages: Voltages) -> None:
        """Add a frame (measurements,) [ohm] of the untouched sensor to the references."""
        self._earlier.append(Earlier(voltages, replace(self.static), replace(self.dynamic)))
        moved = self.dynamic.add(voltages)
        self._opening = self._opening and not moved and self.static.count < MAX_MEAN_FRAMES
        if moved:
            self._earlier.clear()
        if self._opening:  # a longer mean would follow a slow bend
            self.static.add(voltages)

    def without_gain_step(self, voltages: Voltages) -> tuple[Voltages, tuple[str, ...]]:
        """Frame (measurements,) [ohm] at the gain of the session's first, and a step in words.

        Bends of the reference sensor change the channels by amounts whose spread is two thirds of
        their mean or more, touches by more: a step that all channels share is of the board's gain
        or phase, or of the gel's conductivity, and is taken back.
        """
        messages: tuple[str, ...] = ()
        V = voltages / self._gain
        last = self._latest if self._latest.size else np.full_like(V, np.nan)
        comparable = np.isfinite(V) & np.isfinite(last) & (last != 0.0)
        step = V[comparable] / last[comparable] - 1.0
        mean = complex(step.mean()) if len(step) > 3 else 0.0
        if MIN_GAIN_STEP < abs(mean) < MAX_GAIN_STEP and (
            np.sqrt(np.mean(np.abs(step - mean) ** 2)) < self.common * abs(mean)
        ):
            self._gain *= 1.0 + mean
            V = V / (1.0 + mean)
            messages = (
                f"all channels changed by {abs(1.0 + mean) - 1.0:+.2%} and "
                f"{np.degrees(np.angle(1.0 + mean)):+.1f} deg of phase at once, as no touch and no "
                "bend changes them: this is taken back; look at the board's supply and excitation",
            )
        self._latest = np.where(np.isfinite(V), V, last)
        return V, messages

    def with_same_sign(self, voltages: Voltages) -> Voltages:
        """Frame (measurements,) [ohm] with NaN for values that changed their sign in the session.

        No bend or touch turns a positive resistance into a negative one. Methods that work with
        magnitudes would see a sensor at rest. Channels near zero may change their sign. Raises
        UnusableFrameError where most values did.
        """
        reference = self.bend
        change = relative_difference(voltages, reference)
        if not (change < -1.0).any():
            self._reversed = np.zeros(0, np.intp)
            return voltages
        finite = np.isfinite(change)
        size = np.abs(reference)
        large = size > SMALL_MAGNITUDE_SHARE * np.median(size[finite]) if finite.any() else finite
        reversed_ = (change < -1.0) & large
        if 2 * reversed_.sum() > finite.sum():
            raise UnusableFrameError(
                f"{reversed_.sum()} of {finite.sum()} values changed their sign since the "
                "reference: the board has failed or its wires were swapped; mend them and begin a "
                "new session"
            )
        self._reversed = np.flatnonzero(reversed_)
        return np.where(reversed_, np.nan, voltages)

    def without_failed(self, frame: Frame, voltages: Voltages) -> tuple[Voltages, tuple[str, ...]]:
        """Values (measurements,) [ohm] of a frame, NaN of failed electrodes, and these in words.

        Raises UnusableFrameError where too few are left.
        """
        if self.usual is None:
            return voltages, ()
        if self._health is None:
            self._health = SensorHealth(self.usual, frame.protocol)
            self._health.begin(np.abs(self.bend))
        bad = self._health.follow(np.abs(voltages), frame.number, frame.time)
        messages = self._health.problems(frame.protocol.labels)
        good_voltages = np.where(bad, np.nan, voltages)
        require_usable(np.isfinite(good_voltages), *messages)
        return good_voltages, messages

    def to_observations(self, voltages: Voltages) -> Observations:
        """Relative differences of a frame (measurements,) [ohm] to both references.

        Instead of a frame of a touch that stands still the mean of such frames is taken; frames of
        an untouched sensor stay as they are, or the angle would lag behind a slow bend.
        """
        elapsed, most = self._order.elapsed_time, MAX_HELD_FRAMES
        self._turned = self._phases.phase_change(voltages, self.bend)
        static, dynamic = self.static, self.dynamic
        if not self.touched and self.averages:
            self._onset = self._frames_since_onset(voltages)
            if not self._suspected and self._onset > 1:
                since = list(self._earlier)[1 - self._onset :]
                _, static, dynamic = since[0]
                self._held.set_frames([each.voltages for each in since])
            most = self._onset
        going_on = self.touched or self._suspected or most > 1
        held, count = self._held.add(voltages, self.bend, self.averages and going_on, most)
        self._frames, weight = count, self._held.weight
        if self.averages:
            self.static.noise = self.dynamic.noise = self._held.still
        rows = {
            "static": relative_difference(held, static.mean),
            "dynamic": relative_difference(held, dynamic.mean),
            "flat": np.abs(static.mean),
            "frames": weight * count,
            "static_frames": weight * static.count,
            "dynamic_frames": weight * dynamic.count,
            "age": elapsed + self._age_at_start,
            "dynamic_age": elapsed - self._renewed,
        }
        return Observations(**{name: np.asarray(value)[None] for name, value in rows.items()})

    def with_lag(self, perceived: Predictions) -> Predictions:
        """Predictions of one frame whose standard errors cover motion that its mean hides."""
        if not perceived.touches:
            return perceived
        found, lag, earlier = perceived.touches[0], self._held.lag, self._places
        self._places = found.place if len(found.place) else earlier
        if self._frames < 2 or not len(lag) or len(lag) != len(earlier):
            return perceived
        apart = np.linalg.norm(found.place[:, None] - earlier, axis=2)
        found = replace(found, deviation=np.sqrt(found.deviation**2 + lag[apart.argmin(axis=1)]))
        return replace(perceived, touches=(found,))

    def renew(
        self,
        voltages: Voltages,
        touched: bool,
        chance: float = 0.0,
        directions: NDArray[np.float64] | None = None,
        explained: bool = True,
    ) -> None:
        """Renew the references by an untouched frame (measurements,) [ohm]; freeze them else.

        Args:
            voltages: voltages of the frame.
            touched: whether it is.
            chance: probability that it is; where it may be, references wait, and the next frame is
                weighed together with it.
            directions: directions of changes by a motion of its touches along x, along y, by all
                of their forces, and by bends; see `Method.motions`.
            explained: whether its touches explain the frame.
        """
        if directions is not None:
            directions = self._touches.renew(voltages, directions)
        elif not touched:
            self._lingers = self._touches.linger(voltages, self.touch, self._held.variance)
        started, self.touched = not self._suspected and self._onset > 1, touched
        self._suspected = touched or (
            self.averages and (chance > SUSPICION_PROBABILITY or self._lingers)
        )
        self._held.settle(touched, explained)
        if directions is not None or not self._suspected:
            self._held.directions = np.zeros((0, 0)) if directions is None else directions
        if self._suspected and started:
            _, self.static, self.dynamic = list(self._earlier)[1 - self._onset]
        if self._suspected:
            self._earlier.clear()
        if touched:
            self._opening, self._lingers = False, False
        elif not self._suspected:
            self.average(voltages)
            self._outdated, self._renewed = False, self._order.elapsed_time

    def _frames_since_onset(self, voltages: Voltages) -> int:
        """Number of the latest frames, V among them, that differ most from those before."""
        if self._suspected:
            latest = [*self._held.latest, voltages]
            earlier = [self.dynamic] * len(latest)
        else:
            latest = [*(each.voltages for each in self._earlier), voltages]
            earlier = [*(each.dynamic for each in self._earlier), self.dynamic]
        most = min(len(latest), MAX_HELD_FRAMES)
        latest, earlier = latest[: -most - 1 : -1], earlier[: -most - 1 : -1]
        earlier = list(takewhile(lambda each: each.count >= MIN_EARLIER, earlier))
        if not earlier:
            return 1
        counts = np.arange(1, len(earlier) + 1)
        sums: Voltages = np.cumsum(latest[: len(earlier)], axis=0, dtype=np.complex128)
        means = sums / counts[:, None]
        references = np.array([each.mean for each in earlier])
        reference_counts = np.array([each.count for each in earlier])
        shown = self._held.shows(means, counts, references, reference_counts)
        best = int(shown.argmax())
        return best + 1 if shown[best] > (0.0 if self._suspected else 1.0) else 1

    def with_hidden(self, voltages: Voltages, observed: Observations) -> Observations | None:
        """Observations of a frame whose touches are there yet, though a bend hides them.

        The dynamic reference becomes the sensor without them, so bent. None otherwise.
        """
        variance = self._held.variance if self._held.is_noise_known else None
        held = self.touched or self._lingers
        reference = self._touches.bent_reference(voltages, held, variance)
        if reference is None:
            return None
        self.dynamic.restart(reference)
        weight = np.asarray(self._held.weight)[None]
        return replace(
            observed,
            static=relative_difference(voltages, self.static.mean)[None],
            dynamic=relative_difference(voltages, reference)[None],
            frames=weight,
            dynamic_frames=weight,
        )

    def problems(self, labels: tuple[str, ...]) -> tuple[str, ...]:
        """Faults of the references in words; `labels` are those of the measurements."""
        problems = [f"{self.doubt}; {START_REMEDY}"] if self.doubt else []
        when = "the session began" if self.stored is None else "the stored reference was taken"
        bad = np.flatnonzero(~np.isfinite(self.bend))
        problems += [f"channel {labels[i]} is left out: it was bad when {when}" for i in bad]
        problems += [
            f"channel {labels[i]} is left out: its sign changed since {when}; check its electrodes "
            "and the board"
            for i in self._reversed
        ]
        if len(self._turned):
            worst = int(np.nanargmax(np.abs(self._turned)))
            problems.append(
                f"phases changed since {when}, by {np.degrees(self._turned[worst]):+.2g} deg in "
                f"channel {labels[worst]}, as no touch and no bend changes them: a capacitance "
                "across electrodes, or the board; dry the plug, look at its wires"
            )
        if self._lingers:
            problems.append("an earlier touch may go on, too faintly to locate")
        if self._outdated and self.touched and self.bends:
            problems.append(
                f"no frames came for more than {MAX_GAP:g} s before this touch: its position "
                "is wrong if the sensor has been bent since"
            )
        return tuple(problems)
