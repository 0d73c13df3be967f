"""Bend and touches found together, by fitting a learned model of the sensor to the voltages."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar
from typing import Protocol as Interface

import numpy as np
from numpy.typing import NDArray

from eitskin.protocol import Protocol
from eitskin.simulator.instrument.drift import DRIFT_TIME
from eitskin.training.joint.bend_curve import BendCurve, BendCurves
from eitskin.training.joint.bend_estimate import (
    BEYOND_DEG,
    AngleEstimate,
    angle_error,
    checked_angle,
    estimate_angle,
)
from eitskin.training.joint.channel_faults import PossibleFaults, possible_faults
from eitskin.training.joint.model_selection import THRESHOLD, Explanation, explain
from eitskin.training.joint.objective import STILL_DEG, Habits, TouchProblem, excess, skew
from eitskin.training.joint.proposal_model import Proposals, network_inputs
from eitskin.training.joint.specimen_features import SpecimenFeatures
from eitskin.training.joint.touch_discs import disc_map
from eitskin.training.joint.touch_response import TouchResponse
from eitskin.training.joint.touch_search import Candidates
from eitskin.training.method.calibration import Calibration, KnownBends
from eitskin.training.method.input_spec import Layout
from eitskin.training.method.learning_curve import History
from eitskin.training.method.observations import UNKNOWN_AGE, Observed
from eitskin.training.method.predictions import FoundTouches, Perceived

Array = NDArray[np.float64]
Arrays = dict[str, NDArray[np.generic]]

HISTORIES = ("response", "proposals")  # networks, by the names of their parts
REJECTED = THRESHOLD - 2.0  # most evidence that a touch which was not kept may leave
STEP_DEG = 10.0  # of the angles for which candidates are kept
SAME_SPECIMEN = 0.008  # spread of log ratios of two sessions of a sensor; paths err by 0.4 %
UNEXPLAINED = 6.0  # standard deviations of the misfit above its expectation that are told


class _Part(Interface):
    def arrays(self) -> Mapping[str, NDArray[np.floating]]: ...


@dataclass(frozen=True, slots=True, eq=False)
class JointMethod:
    """A learned model of sensors of one design, and its fit to frames.

    log V = log V_flat + bend curve + responses of the touches + common drift + noise. Everything
    but the noise is learned (`joint_training`); what differs between specimens and does not show in
    their flat resistances has a learned covariance, which the fit weighs against the noise.

    Attributes:
        features: of a specimen, from its flat resistances.
        response: to touches.
        curves: of bending.
        proposals: of places, from which the fit starts.
        habits: of touches.
        noise: standard deviation of log V in one frame (C,).
        drift: standard deviation after four hours of the factor common to all measurements.
        places: that are tried for touches (n, 2) [m].
        radius: of the indenters [m].
        size: length and width of the sensor [m].
        shape: of touch maps.
        protocol: of the measurements.
        histories: how the losses of its networks fell while they were trained.
        calibrated: the curve of one specimen, where one was calibrated.
        calibrated_flat: magnitudes of that specimen, flat and untouched (C,) [ohm].
    """

    KIND: ClassVar[str] = "joint"
    AVERAGES: ClassVar[bool] = True

    features: SpecimenFeatures
    response: TouchResponse
    curves: BendCurves
    proposals: Proposals
    habits: Habits
    noise: Array
    drift: float
    places: Array
    radius: float
    size: tuple[float, float]
    shape: tuple[int, int]
    protocol: Protocol
    histories: Mapping[str, History] = field(default_factory=dict)
    calibrated: BendCurve | None = None
    calibrated_flat: Array | None = None
    _specimens: "dict[bytes, _Specimen]" = field(default_factory=dict, init=False, repr=False)
    _tried: dict[int, Array] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        """What all specimens share of touches at the places tried, by steps of the angle."""
        low, high = self.curves.angle_deg
        steps = range(_step(low - BEYOND_DEG), _step(high + BEYOND_DEG) + 1)
        force = np.full(len(self.places), self.response.ranges.middle_force)
        touches = np.column_stack([self.places, force])
        self._tried.update({step: self.response.hidden(touches, step * STEP_DEG) for step in steps})

    def perceive(self, observed: Observed) -> Perceived:
        """What n frames show, one after the other."""
        return Perceived.joined([self._perceive(observed[i : i + 1]) for i in range(len(observed))])

    def _perceive(self, frame: Observed) -> Perceived:
        specimen = self._specimen(frame.flat[0])
        static, dynamic = _log1p(frame.static[0]), _log1p(frame.dynamic[0])
        static_share, dynamic_share = 1.0 / frame.static_frames[0], 1.0 / frame.dynamic_frames[0]
        reference = AngleEstimate(0.0, 0.0, 0.0)
        if np.nanmax(np.abs(static - dynamic), initial=0.0) > 0:
            noise = self._noise(static_share + dynamic_share, frame.age[0])
            reference = specimen.angle(static - dynamic, noise)
        reference_deg = reference.angle_deg
        proposed = self.proposals.places(
            network_inputs(dynamic, np.sqrt(2.0) * self.noise, reference_deg, specimen.features),
            self.habits.separation,
        )
        problem = TouchProblem.of(
            dynamic,
            self._noise(1.0 / frame.frames[0] + dynamic_share, frame.dynamic_age[0]),
            reference_deg,
            specimen.response,
            specimen.curve,
            self.habits,
        )
        found = explain(problem, specimen.candidates(reference_deg), proposed, specimen.faults)
        for fault in found.faults:
            static[list(fault.members)] = np.nan
        if len(found.touches):
            deviation = float(np.hypot(found.angle_deviation_deg, reference.deviation_deg))
            bend = replace(reference, angle_deg=found.angle_deg, deviation_deg=deviation)
        else:
            noise = self._noise(1.0 / frame.frames[0] + static_share, frame.age[0])
            moved = found.angle_deg - reference_deg
            if abs(moved) > STILL_DEG:
                noise = noise + skew(specimen.curve.slope(found.angle_deg), moved)
            bend = specimen.angle(static, noise)
        return self._said(found, bend, specimen.doubts)

    def _said(self, found: Explanation, bend: AngleEstimate, doubts: tuple[str, ...]) -> Perceived:
        angle_deg, deviation_deg = bend.angle_deg, bend.deviation_deg
        spread = np.sqrt(np.trace(found.covariance[:, :2, :2], axis1=1, axis2=2))
        map_ = disc_map(
            found.touches[:, :2], spread / np.sqrt(2.0), self.radius, self.size, self.shape
        )
        strength = 1.0 - 0.5 * np.exp(-np.maximum(found.gains - THRESHOLD, 0.0) / (2 * THRESHOLD))
        return Perceived(
            self._probabilities(found, angle_deg, deviation_deg)[None],
            np.array([angle_deg]),
            np.array([deviation_deg]),
            map_[None],
            (FoundTouches.of(found.touches[:, :2], strength, found.touches[:, 2], spread),),
            (doubts + self._doubts(found, bend),),
        )

    def _probabilities(self, found: Explanation, angle_deg: float, deviation_deg: float) -> Array:
        """Of idle, touch and bend (3,).

        Touched by the gain of the first touch. Else flat, or bent by an angle that could be any of
        those learned: by Bayes' rule for one normal measurement.
        """
        # Evidence of a touch that was not kept is none for this state.
        evidence = found.evidence if len(found.touches) else min(found.evidence, REJECTED)
        touched = 1.0 / (1.0 + np.exp(-np.clip(0.5 * (evidence - THRESHOLD), -30, 30)))
        low, high = self.curves.angle_deg
        bent = deviation_deg * np.sqrt(2 * np.pi) / (high - low)
        bent *= np.exp(np.minimum(0.5 * (angle_deg / deviation_deg) ** 2, 700.0))
        flat = 1.0 / (1.0 + bent)
        return np.array([(1 - touched) * flat, touched, (1 - touched) * (1 - flat)])

    def _other_specimen(self, flat: Array) -> tuple[str, ...]:
        """Whether a sensor is not the one that was calibrated."""
        if self.calibrated_flat is None:
            return ()
        logs = np.log(flat / self.calibrated_flat)
        spread = float(np.nanstd(logs))
        if spread < SAME_SPECIMEN:
            return ()
        return (
            f"the flat sensor differs by {spread:.1%} from the one that this pipeline was "
            f"calibrated for (up to {SAME_SPECIMEN:.1%} are expected): calibrate again, or use "
            "the pipeline that was not calibrated",
        )

    def _doubts(self, found: Explanation, bend: AngleEstimate) -> tuple[str, ...]:
        said = tuple(
            f"{fault.name} and was left out: look at its contact and wire" for fault in found.faults
        )
        said += tuple(
            f"{fault.name} since the session began and was left out of the angle: begin a new "
            "session with the flat sensor"
            for fault in bend.faults
        )
        if bend.excess > UNEXPLAINED:
            said += (
                f"no angle explains this frame ({bend.excess:.0f} standard deviations off): do not "
                "rely on it, and begin a new session with the flat sensor",
            )
        return said + self._unexplained(found)

    def _unexplained(self, found: Explanation) -> tuple[str, ...]:
        if excess(found.misfit, found.freedom) < UNEXPLAINED:
            return ()
        return (
            f"no bend and up to four touches explain this frame (misfit {found.misfit:.0f}, "
            f"expected about {found.freedom}): touches of another kind, a bad contact, or a "
            "reference that is out of date; do not rely on its touches",
        )

    def _noise(self, frames: float, age: float) -> Array:
        """Covariance (C, C) of a difference of means of frames, `age` seconds apart.

        `frames` is the sum of one over the numbers of frames that were averaged.
        """
        drift = self.drift**2 * max(age, 0.0) / DRIFT_TIME
        covariance = np.full((len(self.noise), len(self.noise)), drift)
        np.einsum("ii->i", covariance)[:] += self.noise**2 * frames
        return covariance

    def _specimen(self, flat: Array) -> "_Specimen":
        key = flat.tobytes()
        if key not in self._specimens:
            if len(self._specimens) > 64:
                self._specimens.clear()
            p = self.features.apply(flat)
            curve = self.calibrated or self.curves.of(p)
            self._specimens[key] = _Specimen(
                self, p, curve, self._other_specimen(flat), possible_faults(self.protocol, flat)
            )
        return self._specimens[key]

    def adapted(self, known: KnownBends) -> "tuple[JointMethod, Calibration]":
        """The method for one sensor: its bend curve given known angles, by Bayes' rule.

        What is fitted is the sensor's own part of the curve, whose prior was learned from the
        specimens trained with: what differing hinges, layers and contacts do, without naming them.
        Errors of the known angles themselves are taken to be none.
        """
        p = self.features.apply(known.flat)
        prior = self.curves.of(p)
        count, channels = known.change.shape
        together = np.eye(count) + 1.0 / known.flat_frames  # all share the flat frames' noise
        walk = np.minimum(known.age[:, None], known.age) / DRIFT_TIME * self.drift**2
        noise = np.asarray(np.kron(together, np.diag(self.noise**2)), dtype=float)
        noise = noise + np.kron(walk, np.ones((channels, channels)))
        curve = prior.conditioned(known.angle_deg, known.change, noise)
        adapted = replace(self, calibrated=curve, calibrated_flat=known.flat)
        share = 1.0 + 1.0 / known.flat_frames
        residuals = [
            estimate_angle(curve, change, self._noise(share, age))[0] - angle
            for change, age, angle in zip(known.change, known.age, known.angle_deg, strict=True)
        ]
        low, high = self.curves.angle_deg
        angles = tuple(float(angle) for angle in np.linspace(low, high, 8))
        errors = [
            tuple(angle_error(each, angle, self._noise(share, UNKNOWN_AGE)) for angle in angles)
            for each in (prior, curve)
        ]
        rms = float(np.sqrt(np.mean(np.square(residuals))))
        return adapted, Calibration(angles, errors[0], errors[1], rms)

    def outputs(self, observed: Observed) -> Arrays:
        """What it makes of n frames, for checking copies."""
        said = self.perceive(observed)
        return {
            "probabilities": said.probabilities,
            "bend_angle_deg": said.bend_angle_deg,
            "touch_map": said.touch_map,
        }

    def arrays(self) -> Arrays:
        """What `from_arrays` needs to make it again."""
        habits = self.habits
        own: Arrays = {
            "noise": self.noise,
            "scalars": np.array([self.drift, self.radius, habits.separation, *habits.force]),
            "bounds": np.array([habits.low, habits.high]),
            "places": self.places,
        }
        parts: dict[str, _Part] = {
            "features": self.features,
            "response": self.response,
            "curves": self.curves,
            "proposals": self.proposals,
        }
        if self.calibrated is not None:
            parts["calibrated"] = self.calibrated
        if self.calibrated_flat is not None:
            own["calibrated_flat"] = self.calibrated_flat
        for name, history in self.histories.items():
            own |= {f"{name}.{key}": array for key, array in history.arrays().items()}
        for name, part in parts.items():
            own |= {f"{name}.{key}": array for key, array in part.arrays().items()}
        return own

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, NDArray[np.generic]], layout: Layout
    ) -> "JointMethod":
        """The method that `arrays` came from; raises KeyError where they lack some."""

        def part(name: str) -> dict[str, NDArray[np.generic]]:
            mine = (key for key in arrays if key.startswith(f"{name}."))
            return {key.removeprefix(f"{name}."): arrays[key] for key in mine}

        drift, radius, separation, *force = arrays["scalars"].astype(float).tolist()
        low, high = arrays["bounds"].astype(float)
        features, calibrated = part("features"), part("calibrated")
        return cls(
            SpecimenFeatures(
                features["middle"].astype(float), features["directions"].astype(float)
            ),
            TouchResponse.from_arrays(part("response")),
            BendCurves.from_arrays(part("curves")),
            Proposals.from_arrays(part("proposals")),
            Habits(separation, (force[0], force[1]), low, high),
            arrays["noise"].astype(float),
            drift,
            arrays["places"].astype(float),
            radius,
            layout.outline,
            layout.pixels,
            layout.protocol,
            {name: History.from_arrays(part(name)) for name in HISTORIES},
            BendCurve.from_arrays(calibrated) if calibrated else None,
            arrays["calibrated_flat"].astype(float) if calibrated else None,
        )


def _log1p(difference: Array) -> Array:
    """log(V / ref) of dV; NaN for a measurement that is bad or has no logarithm."""
    with np.errstate(divide="ignore", invalid="ignore"):
        change = np.log1p(difference)
    return np.where(np.isfinite(change), change, np.nan)


class _Specimen:
    """The model of one specimen, and candidates at the angles that were asked for."""

    def __init__(
        self,
        method: JointMethod,
        features: Array,
        curve: BendCurve,
        doubts: tuple[str, ...],
        faults: PossibleFaults,
    ) -> None:
        self.features, self.curve = features, curve
        self.response = method.response.of(features)
        self.doubts = doubts
        self.faults = faults
        self._places, self._tried = method.places, method._tried
        self._last: tuple[bytes, AngleEstimate] | None = None
        self._candidates: dict[int, Candidates] = {}

    def angle(self, change: Array, noise: Array) -> AngleEstimate:
        """Of an untouched frame; that of the last one is kept, for references that are frozen."""
        key = change.tobytes() + noise.tobytes()
        if self._last is None or self._last[0] != key:
            self._last = (key, checked_angle(self.curve, change, noise, self.faults))
        return self._last[1]

    def candidates(self, angle_deg: float) -> Candidates:
        """At the nearest angle that is kept."""
        step = _step(angle_deg)
        if step not in self._candidates:
            force = self.response.response.ranges.middle_force
            change = self._tried[step] @ self.response.output.T
            self._candidates[step] = Candidates(self._places, force, change)
        return self._candidates[step]


def _step(angle_deg: float) -> int:
    """Of the angles for which candidates are kept, the number of the nearest."""
    return round(angle_deg / STEP_DEG)
