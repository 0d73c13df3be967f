"""The joint method: bend and touches of a frame as the MAP estimate of a learned sensor model."""

from collections.abc import Mapping
from dataclasses import astuple, dataclass, field, replace
from functools import cache
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray

from eitskin.compiled import kernels
from eitskin.datasets.store.frame_tensors import touch_maps
from eitskin.errors import DataError
from eitskin.protocol import Protocol
from eitskin.simulator.instrument.drift import DRIFT_TIME
from eitskin.threads import one_thread
from eitskin.training.joint.adaptation import (
    adapted_curve,
    likeliest_response,
    noise_scale,
    own_output,
    own_response,
    require_plausible,
    twin_trial,
)
from eitskin.training.joint.bend_curve import BendCurve, BendCurvePrior
from eitskin.training.joint.channel_faults import possible_faults
from eitskin.training.joint.combinations import (
    Combinations,
    CombinedChange,
    SpecimenFeatures,
    log_change,
)
from eitskin.training.joint.fit_kernels import STILL_DEG
from eitskin.training.joint.frame_predictions import (
    ErrorScale,
    calibration_problems,
    disc_map,
    fit_problems,
    own_error_scale,
    state_probabilities,
)
from eitskin.training.joint.model_selection import FrameFit, PlainFit, fit_plain
from eitskin.training.joint.networks import AngleNetworks, ProposalNetwork, network_inputs
from eitskin.training.joint.objective import TOUCH_THRESHOLD, TouchObjective
from eitskin.training.joint.specimen_model import (
    LOG_ODDS,
    MOVED_DEG,
    RIVAL,
    AngleEstimate,
    SpecimenModel,
)
from eitskin.training.joint.touch_response import SpecimenResponse, TouchPrior, TouchResponse
from eitskin.training.joint.training import fit_joint, held_out_touches
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.method.interface import Adaptation, LearningCurve, Method
from eitskin.training.method.known_frames import KnownFrames
from eitskin.training.method.observations import Observations
from eitskin.training.method.predictions import FoundTouches, Predictions
from eitskin.training.method.settings import Progress, TrainingSettings
from eitskin.training.method.stored_fields import (
    GIVEN_FIELD,
    Arrays,
    StoredField,
    arrays_with_prefix,
    field_arrays,
    prefix_arrays,
    restored_fields,
)
from eitskin.training.method.targets import Targets, TrainingFrames

Array = NDArray[np.float64]

NETWORKS = ("response", "proposals", "angles")  # parts whose learning curves are stored
OTHER_ODDS = -2.0  # logarithm of the odds of the other response, before a frame is seen
SKEW_DEG = 6.0  # standard deviation of a bend within a frame: 20 deg/s in 0.3 s
FURTHER_DEG = 15.0  # to a second direction of bends, which has their curvature


@dataclass(frozen=True, slots=True, eq=False)
class JointMethod(Method):
    """A learned model of the sensors of one design, and its fit to frames.

    Without bend curves (`BendCurvePrior.bends`) the sensor is taken to stay flat: neither the bend
    angle nor the state bend is estimated. Without `places` it is taken to stay untouched.

    log V = log V_flat + bend curve + sum of touch responses + common drift + noise, in K
    combinations of the C measurements (`Combinations`). Every term is learned
    (`joint/training.py`). Differences between specimens that their flat resistances do not
    show have a learned covariance, which the fit weighs against the noise.

    Attributes:
        features: features of a specimen, from its flat resistances.
        response: response to touches.
        bend_prior: distribution of the bend curves.
        proposals: network whose positions the fit starts from.
        touch_prior: touch prior of positions, forces and distances.
        combinations: combinations of the measurements, and the noise of these in one frame.
        drift: standard deviation after four hours of the factor common to all measurements.
        places: positions that are tried for touches (n, 2) [m]; none where no touch was learned.
        radius: radius of the indenters [m].
        size: length and width of the sensor [m].
        shape: rows and columns of touch maps.
        protocol: protocol of the measurements.
        learning_curves: losses of the networks during training, by their names.
        calibrated: bend curve of the calibrated specimen, if any.
        calibrated_flat: magnitudes of that specimen, flat and untouched (C,) [ohm].
        angles: networks of the bend angle, for sensors that are not calibrated; None where the bend
            curve alone shows it as well.
        angle_features: angle features of a specimen, which the networks are given; None where those
            are `features`.
        usual, other_usual: bend curves of the commonest clamp and of sensors on plates, or None.
        other_response: another response that a sensor may have, as to touches on plates.
        forces: whether touches have forces; else these are strengths, relative to the usual touch.
        error_scale: factor of the standard errors of places, from training specimens that the
            response was learned without.
        own_error_scale: a further one, from known touches of the sensor that the method is adapted
            to; 1 before.
        own_noise_scale: noise of that sensor's frames relative to that in training; 1 before.
        own_output: last layer of the response of that sensor, from its twin and known touches (K,
            hidden + 1); None without.
        own_latent: its derivatives by what is still unknown of that sensor (Q, K, hidden + 1); None
            without known touches.
        own_other: whether that is a last layer of the other response.
    """

    KIND: ClassVar[str] = "joint"
    AVERAGES: ClassVar[bool] = True
    FITTED: ClassVar[bool] = True

    features: SpecimenFeatures
    response: TouchResponse
    bend_prior: Annotated[BendCurvePrior, StoredField("curves")]
    proposals: ProposalNetwork
    touch_prior: Annotated[TouchPrior, GIVEN_FIELD]
    combinations: Annotated[Combinations, GIVEN_FIELD]
    drift: Annotated[float, GIVEN_FIELD]
    places: Array
    radius: Annotated[float, GIVEN_FIELD]
    size: Annotated[tuple[float, float], GIVEN_FIELD]
    shape: Annotated[tuple[int, int], GIVEN_FIELD]
    protocol: Annotated[Protocol, GIVEN_FIELD]
    learning_curves: Annotated[Mapping[str, LearningCurve], GIVEN_FIELD] = field(
        default_factory=dict
    )
    calibrated: BendCurve | None = None
    calibrated_flat: Array | None = None
    angles: AngleNetworks | None = None
    angle_features: SpecimenFeatures | None = None
    usual: BendCurvePrior | None = None
    other_usual: BendCurvePrior | None = None
    other_response: TouchResponse | None = None
    forces: bool = True
    error_scale: Annotated[ErrorScale, GIVEN_FIELD] = field(default_factory=ErrorScale)
    own_error_scale: float = 1.0
    own_noise_scale: float = 1.0
    own_output: Array | None = None
    own_latent: Array | None = None
    own_other: bool = False
    _specimens: dict[bytes, SpecimenModel] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    @one_thread()  # sums, and so the bytes of a pipeline, depend on their number
    def fit(
        cls, frames: TrainingFrames, settings: TrainingSettings, progress: Progress
    ) -> "JointMethod":
        method = fit_joint(
            cls, frames.dataset, frames.spec, settings.joint, settings.seed, progress
        )
        unseen = held_out_touches(frames.dataset) if method.touches else None
        if unseen is None:
            return method
        observations = Observations.from_dataset(unseen)
        touches = method.predict(observations).touches
        true_places = np.stack([unseen.touch_x, unseen.touch_y], axis=-1).astype(float)
        scale = ErrorScale.fit(true_places, touches, method.features.clip(observations.flat))
        return replace(method, error_scale=scale)

    @property
    def targets(self) -> Targets:
        """Quantities that the method estimates."""
        bends, touches = self.bend_prior.bends, self.touches
        states_estimated = {"idle": True, "touch": touches, "bend": bends}
        states = tuple(name for name, is_estimated in states_estimated.items() if is_estimated)
        return Targets(states, bends, touches, touches and self.forces)

    @property
    def noise_scale(self) -> float:
        return self.own_noise_scale

    @property
    def touches(self) -> bool:
        """Whether touches were learned."""
        return bool(len(self.places))

    def predict(self, observations: Observations) -> Predictions:
        """Predictions for n frames, each independent of the others."""
        frames = (observations[i : i + 1] for i in range(len(observations)))
        with kernels(), one_thread():  # more of them wait for each other longer than they work
            return Predictions.concatenate([self._predict(frame) for frame in frames])

    def motions(self, observations: Observations, predictions: Predictions) -> Array:
        last, angle = predictions.touches[0], float(np.nan_to_num(predictions.bend_angle_deg[0]))
        touches = np.column_stack([last.place, last.force if self.forces else last.strength])
        specimen = self._specimen(observations.flat[0])
        with kernels():
            changes = specimen.response.with_derivatives(touches, angle)[1:]
        changes[2] *= touches[:, 2:]
        bends = [angle, angle + FURTHER_DEG] if self.bend_prior.bends else []
        slopes = [specimen.curve.slope(each) for each in bends]
        return np.vstack([*changes, *slopes]) @ self.combinations.back

    def _predict(self, frame: Observations) -> Predictions:
        """Predictions for one frame.

        The angle of the dynamic reference comes first, then touches and motion since that
        reference; the angle of an untouched frame is estimated from the static reference.
        """
        specimen, bends = self._specimen(frame.flat[0]), self.bend_prior.bends
        static, dynamic = log_change(frame.static[0]), log_change(frame.dynamic[0])
        share, static_share, dynamic_share = (
            1.0 / each[0] for each in (frame.frames, frame.static_frames, frame.dynamic_frames)
        )
        reference = AngleEstimate(0.0, 0.0, 0.0)
        if bends and np.nanmax(np.abs(static - dynamic), initial=0.0) > 0:
            shares = static_share + dynamic_share
            apart = frame.age[0] - frame.dynamic_age[0]
            shift = self._project_change(static - dynamic, shares, apart)
            reference = specimen.angle(shift)
            if reference.faults:  # or the sensor moved while the reference was measured
                late = SKEW_DEG * (self.combinations.lateness @ specimen.curve.slope(0.0))
                moving = specimen.angle(replace(shift, further=np.outer(late, late)))
                reference = reference if moving.faults else moving
        change = self._project_change(dynamic, share + dynamic_share, frame.dynamic_age[0])

        frame_fit = self._fit_likelier(change, reference, specimen)
        static[[member for fault in frame_fit.faults for member in fault.members]] = np.nan
        if len(frame_fit.touches) and not frame_fit.faults:
            turn = MOVED_DEG * frame_fit.estimate.objective.curve.slope(reference.angle_deg)
            improbability = frame_fit.estimate.whole_improbability
            faulty = specimen.faults.alone(change, turn[None], improbability + RIVAL)
            if faulty and faulty.improbability < improbability:
                objective = replace(frame_fit.estimate.objective, combined=faulty.rest)
                frame_fit = FrameFit.without_touches(objective, faulty.faults)
                static -= change.measured - faulty.rest.measured
            elif faulty:
                frame_fit.rival = faulty.names
        touched, angle_deg = len(frame_fit.touches), frame_fit.angle_deg
        if not bends:
            bend = AngleEstimate(np.nan, np.nan, 0.0)
        elif touched and not frame_fit.faults and specimen.bends_since(reference, angle_deg):
            seen = specimen.angle(frame_fit.take_touches_out(change))
            bend = replace(reference, angle_deg=seen.angle_deg, deviation_deg=seen.deviation_deg)
        elif touched:
            deviation = float(np.hypot(frame_fit.angle_deviation_deg, reference.deviation_deg))
            bend = replace(reference, angle_deg=angle_deg, deviation_deg=deviation)
        else:
            change_seen = self._project_change(static, share + static_share, frame.age[0])
            moved = angle_deg - reference.angle_deg
            if abs(moved) > STILL_DEG:
                # The first and the last of a frame's measurements see different angles. The speed
                # is unknown; the motion since the previous frame bounds it.
                slope = frame_fit.estimate.objective.curve.slope(angle_deg)
                late = moved * (self.combinations.lateness @ slope)
                change_seen = replace(change_seen, further=np.outer(late, late))
            bend = specimen.angle(change_seen)
        return self._prediction(frame_fit, bend, specimen)

    def _fit_likelier(
        self, change: CombinedChange, reference: AngleEstimate, specimen: SpecimenModel
    ) -> FrameFit:
        """The fit to one frame by the response or, where that is likelier, by the other one.

        With the bend curve that a reference of the bent sensor shows. Where the sensor has moved
        since one of the flat sensor, with the likelier curve.
        """
        angle_deg = reference.angle_deg

        @cache
        def propose() -> Array:
            deviation = np.sqrt(2.0) * self.combinations.unit
            inputs = network_inputs(change.change, deviation, angle_deg, specimen.features)
            return self.proposals.places(inputs, self.touch_prior.separation)

        curve, other = specimen.curve, specimen.other
        if specimen.usual and angle_deg != 0.0 and reference.usual > 0.5:
            curve = specimen.usual[reference.usual_curve]

        def fit(model: SpecimenModel, curve: BendCurve) -> PlainFit:
            objective = TouchObjective(change, angle_deg, model.response, curve, self.touch_prior)
            candidates = model.candidates(angle_deg, self.places)
            return fit_plain(objective, candidates, propose if self.touches else None)

        likelier = fit(specimen, curve)
        if specimen.usual and not angle_deg and abs(likelier.best.at.angle_deg) >= MOVED_DEG:
            by_touches = likelier.best.at.changes.sum(axis=0)
            usual = specimen.likeliest_usual(change.change - by_touches, change.noise)
            rival = fit(specimen, usual)
            if rival.best.beats(likelier.best, LOG_ODDS):
                likelier, curve = rival, usual
        likelier = likelier.without_faults(specimen.faults)
        if other and likelier.may_be_touched and likelier.may_fit_better(other.response):
            rival = fit(other, curve).without_faults(specimen.faults)
            if rival.best.beats(likelier.best, OTHER_ODDS):
                likelier = rival
        return likelier.complete()

    def _prediction(
        self, fit: FrameFit, bend: AngleEstimate, specimen: SpecimenModel
    ) -> Predictions:
        """One frame's predictions from its fit."""
        places, force = fit.touches[:, :2], fit.touches[:, 2] if self.forces else None
        spread = np.sqrt(np.trace(fit.covariance[:, :2, :2], axis1=1, axis2=2))
        spread *= self.error_scale.evaluate(specimen.features) * self.own_error_scale
        spread = np.hypot(spread, np.sqrt(fit.hidden_variance))
        if self.touches:
            x, y = places.T[:, None]
            map_ = touch_maps(x, y, np.full_like(x, self.radius), self.size, self.shape)
        else:
            map_ = np.full((1, *self.shape), np.nan, np.float32)
        surplus = np.maximum(fit.estimate.gains - TOUCH_THRESHOLD, 0.0)
        strength = 1.0 - 0.5 * np.exp(-surplus / (2 * TOUCH_THRESHOLD))
        bends = self.bend_prior.angle_deg if self.bend_prior.bends else None
        return Predictions(
            (chances := state_probabilities(fit, bend, bends, self.touches))[None],
            np.array([bend.angle_deg]),
            np.array([bend.deviation_deg]),
            map_,
            (FoundTouches.from_arrays(places, strength, force, spread),),
            (specimen.problems + fit_problems(fit, bend, bends, self.touches, chances),),
        )

    def _project_change(self, change: Array, frames: float, age: float) -> CombinedChange:
        """Combinations of the difference of two means of frames.

        Args:
            change: change of log V (C,); NaN where a measurement is bad.
            frames: sum of the reciprocal numbers of frames in both means.
            age: time between the means [s].
        """
        drift = self.drift**2 * max(age, 0.0) / DRIFT_TIME
        return self.combinations.combine(change, self.own_noise_scale**2 * frames, drift)

    def _specimen(self, flat: Array) -> SpecimenModel:
        """The model of the specimen with these flat magnitudes (C,) [ohm]; the latest are kept."""
        key = flat.tobytes()
        if key not in self._specimens:
            if len(self._specimens) > 64:
                self._specimens.clear()
            p, learned = self.features.clip(flat), self.calibrated is None
            shown = self.angle_features.apply(flat) if self.angle_features else p
            features, own = self.features.apply(flat), self.own_output is not None
            priors = [u for u in (self.usual, self.other_usual) if u and learned]
            self._specimens[key] = SpecimenModel(
                p,
                self.responses(flat)[0] if own else self.response.for_specimen(features),
                self.calibrated or self.bend_prior.predict(p),
                possible_faults(self.protocol, flat),
                calibration_problems(flat, self.calibrated_flat),
                (self.angles, shown) if self.angles and learned else None,
                tuple(each.predict(p) for each in priors),
                None if own or not self.other_response else (self.other_response, features),
            )
        return self._specimens[key]

    def responses(self, flat: Array) -> list[SpecimenResponse]:
        """Responses to touches that the sensor with these flat magnitudes (C,) [ohm] may have.

        Its own, where that is known; else those learned, the usual one first.
        """
        features = self.features.apply(flat)
        learned = [
            each.for_specimen(features) for each in (self.response, self.other_response) if each
        ]
        if self.own_output is None:
            return learned
        return [own_response(learned[self.own_other], self.own_output, self.own_latent)]

    def adapt(self, known: KnownFrames) -> "tuple[JointMethod, Adaptation]":
        """The method adapted to one sensor by known frames, from what was learned in training.

        An adaptation before has no effect.
        """
        bent = known[known.is_bent] if self.bend_prior.bends else known[:0]
        touched = known[known.has_touches & self.touches]
        flat, count = known.observations.flat[0], int(known.flat.sum())
        left_out = len(known) - count - len(bent) - len(touched)
        adaptation = Adaptation(count, len(bent), len(touched), left_out)
        p, used = self.features.clip(flat), len(bent) + len(touched)
        noise = noise_scale(known, self.combinations) if used else 1.0
        adapted = replace(
            self,
            calibrated=None,
            calibrated_flat=flat,
            own_error_scale=1.0,
            own_noise_scale=noise,
            own_output=None,
            own_latent=None,
            own_other=False,
        )
        if len(bent):
            priors = self.bend_prior, [u for u in (self.usual, self.other_usual) if u], p
            curve, calibration = adapted_curve(
                *priors, bent, adapted._project_change, self.drift, noise
            )
            adaptation = replace(adaptation, calibration=calibration)
            adapted = replace(adapted, calibrated=curve)
        if known.twin is not None and self.touches and self.forces:
            learned = adapted.responses(flat)[0]
            parts = (self.touch_prior, self.radius, self.combinations)
            output = own_output(learned, *parts, known.twin, self.bend_prior.bends)
            trial = twin_trial(learned, output, touched, self.combinations)
            adapted = replace(adapted, own_output=output if trial.accepts_twin else None)
            adaptation = replace(adaptation, twin=trial)
        if len(touched):
            terms = self.combinations, adapted._project_change, self.touch_prior, self.forces
            number, own = likeliest_response(adapted.responses(flat), touched, *terms)
            adapted = replace(adapted, own_other=bool(number))
            adapted = replace(adapted, own_output=own.output, own_latent=own.response.latent_output)
            estimated = adapted.predict(touched.observations).touches
            usual_force = self.touch_prior.force[0] if self.forces else None
            require_plausible(touched, estimated, usual_force)
            adapted = replace(adapted, own_error_scale=own_error_scale(touched.touches, estimated))
        return adapted, replace(adaptation, error_scale=adapted.own_error_scale, noise_scale=noise)

    def outputs(self, observations: Observations) -> Arrays:
        """Arrays of predictions for n frames, by which a saved copy is checked.

        Places and their standard errors are checked as one picture, as version 0.1 saved them.
        """
        predictions = self.predict(observations)
        features = self.features.clip(observations.flat)
        scales = [
            np.sqrt(2.0) * self.own_error_scale * self.error_scale.evaluate(p) for p in features
        ]
        drawn = (self.radius, self.size, self.shape)
        touches = zip(predictions.touches, scales, strict=True)
        maps = [disc_map(each.place, each.deviation / scale, *drawn) for each, scale in touches]
        return {
            "probabilities": predictions.probabilities,
            "bend_angle_deg": predictions.bend_angle_deg,
            "touch_map": np.array(maps) if self.touches else predictions.touch_map,
        }

    def arrays(self) -> Arrays:
        prior, basis = self.touch_prior, self.combinations.basis
        arrays = field_arrays(self) | {
            "noise": self.combinations.noise,
            "scalars": np.array([self.drift, self.radius, prior.separation, *prior.force]),
            "bounds": np.array([prior.low, prior.high]),
            "error_scale": np.array(astuple(self.error_scale)),
        }
        if basis is not None:
            arrays["combinations.basis"] = basis
        for name, curve in self.learning_curves.items():
            arrays |= prefix_arrays(f"{name}.history", curve.arrays())
        return arrays

    @classmethod
    def from_arrays(
        cls,
        arrays: Arrays,
        spec: InputSpec,
        settings: TrainingSettings | None = None,  # noqa: ARG003  the arrays say all
    ) -> "JointMethod":
        drift, radius, separation, *force = arrays["scalars"].astype(float).tolist()
        positive = np.array([drift, radius, separation, force[1], *arrays["noise"].ravel()])
        if not np.all((positive > 0) & (positive < 1e3)):
            raise DataError("expected drift, sizes, forces and noise above zero; train it again")
        low, high = arrays["bounds"].astype(float)
        basis = arrays.get("combinations.basis")  # version 0.1 has none
        left_out = () if "angles.unit" in arrays else ("angles.",)  # losses alone
        stored = {name: array for name, array in arrays.items() if not name.startswith(left_out)}
        return cls(
            **restored_fields(cls, stored),
            touch_prior=TouchPrior(separation, (force[0], force[1]), low, high),
            combinations=Combinations(
                arrays["noise"].astype(float), None if basis is None else basis.astype(float)
            ),
            drift=drift,
            radius=radius,
            size=spec.outline,
            shape=spec.pixels,
            protocol=spec.protocol,
            learning_curves={
                name: LearningCurve.from_arrays(arrays_with_prefix(f"{name}.history", arrays))
                for name in NETWORKS
            },
            error_scale=ErrorScale.from_stored(arrays.get("error_scale", np.ones(()))),
        )
