"""The paper's method: trained stages, and their estimates for frames one by one."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets import UNKNOWN_STATE, Dataset, State, touch_maps
from eitskin.training.method.input_spec import InputSpec, mirrors
from eitskin.training.method.interface import Adaptation, Calibration, LearningCurve, Method
from eitskin.training.method.known_frames import KnownFrames
from eitskin.training.method.observations import MissingChannels, Observations, channel_noise
from eitskin.training.method.predictions import FoundTouches, Predictions
from eitskin.training.method.settings import Progress, TrainingSettings, silent
from eitskin.training.method.stored_fields import (
    GIVEN_FIELD,
    Arrays,
    StoredField,
    field_arrays,
    restored_fields,
)
from eitskin.training.method.targets import (
    STATE_NAMES,
    Targets,
    TrainingFrames,
    most_probable,
    untouched_angles,
)
from eitskin.training.paper.stages import (
    BendAngle,
    Classifier,
    PostProcessor,
    Reconstruction,
    bend_free_projection,
    find_touches,
    signal_to_noise,
)
from eitskin.training.reconstruction.pixel_grid import linear_model

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class PaperMethod(Method):
    """Trained stages of the paper's method.

    The preset "paper" follows sections II and III of the paper. Choices that the paper leaves open:

    - dV is relative to the reference, channel by channel; the paper's equation has no division.
    - R of NOSER has a floor and lambda follows from signal and noise (`Reconstruction`); the paper
      chose lambda "heuristically". The Jacobian is that of the flat nominal sensor at every bend.
    - Maps have about 2560 square pixels and are divided by one standard deviation (`Classifier`).
    - The network's activations (ReLU), the widths of its decoder (32, 16, 1) and of the first
      fully connected layer (64), and a last layer from 16 features to three states.
    - k of SelectKBest comes from cross-validation (`BendAngle`). Idle frames, at 0 degrees, are
      regressed upon next to the bent ones. A touched frame has the angle that its dynamic reference
      had, see `predict`.
    - The whole post-processor, its loss and its training. Touches are connected components of its
      map with weighted centroids; the paper takes one centroid of the image of a single touch.
    - Bad channels are replaced by their conditional mean (`MissingChannels`).

    Attributes:
        reconstruction: one-step Gauss-Newton, for either reference.
        classifier: classifier of the state, from the static reference; None for frames of one
            state.
        bend_angle: regression of the angle, from the static reference; None for frames without
            known angles.
        postprocessor: postprocessor from reconstruction to touch map, with the dynamic reference;
            None for frames without touches of known position.
        missing_static, missing_dynamic: imputation of bad channels of dV from either reference.
        outline: length and width that the maps cover [m].
    """

    KIND: ClassVar[str] = "paper"

    reconstruction: Reconstruction
    classifier: Classifier | None
    bend_angle: BendAngle | None
    postprocessor: PostProcessor | None
    missing_static: Annotated[MissingChannels, StoredField("missing_static.covariance")]
    missing_dynamic: Annotated[MissingChannels, StoredField("missing_dynamic.covariance")]
    outline: Annotated[tuple[float, float], GIVEN_FIELD]

    @classmethod
    def fit(
        cls, frames: TrainingFrames, settings: TrainingSettings, progress: Progress = silent
    ) -> "PaperMethod":
        """Training, on all frames, of the stages that they have labels for.

        Losses on `frames.validation` are recorded and change nothing. Raises DataError for too few
        frames of a kind.
        """
        data, seen, spec, noise = frames.dataset, frames.observations, frames.spec, frames.noise
        rms = np.full(seen.dynamic.shape[1], noise)
        if settings.weighted:
            rms = channel_noise(data, seen)
        missing_static = MissingChannels.fit(seen.static, noise)
        missing_dynamic = MissingChannels.fit(seen.dynamic, noise)
        static, dynamic = missing_static.fill(seen.static), missing_dynamic.fill(seen.dynamic)
        touched = data.state == State.TOUCH
        unit = np.where(rms > 0, rms, 1.0)  # a set without noise weighs all channels alike
        snr = signal_to_noise((dynamic[touched] if touched.any() else static) / unit, noise > 0)
        model = linear_model(spec.design, spec.protocol, spec.pixels)
        reconstruction = Reconstruction.fit(model.relative, snr, spec.pixels, unit)
        unseen_states = unseen_touches = None
        if (unseen := frames.validation) is not None:
            others = Observations.from_dataset(unseen)
            unseen_states = _states(unseen, missing_static.fill(others.static))
            unseen_touches = _touches(unseen, missing_dynamic.fill(others.dynamic), spec)
        classifier = bend_angle = postprocessor = None
        if frames.targets.states and (known_states := _states(data, static)):
            maps = np.stack(_state_maps(reconstruction, data.state, static, settings))
            classifier = Classifier.fit(
                *known_states,
                maps,
                reconstruction.shape,
                settings.classifier,
                rms,
                settings.seed,
                progress,
                unseen_states,
                compress=settings.compressed_maps,
            )
        if frames.targets.angle:
            angle = untouched_angles(data)
            usable = np.isfinite(angle)
            labelled = (static[usable], angle[usable], data.specimen[usable])
            bend_angle = BendAngle.fit(*labelled, settings.seed, squares=settings.bend_squares)
        placed = _touches(data, dynamic, spec)
        if "touch" in frames.targets.states and placed:
            flips = [mirror.flips for mirror in mirrors(spec.design, spec.protocol)]
            postprocessor = PostProcessor.fit(
                *placed,
                reconstruction,
                settings.postprocessor,
                rms,
                settings.seed,
                progress,
                unseen_touches,
                flips if settings.mirrored else flips[:1],
            )
        return cls(
            reconstruction,
            classifier,
            bend_angle,
            postprocessor,
            missing_static,
            missing_dynamic,
            spec.outline,
        )

    @property
    def targets(self) -> Targets:
        """Quantities that the trained stages estimate; forces never are."""
        told_apart = self.classifier.states if self.classifier else ()
        states = tuple(STATE_NAMES[state] for state in told_apart)
        return Targets(states, self.bend_angle is not None, self.postprocessor is not None, False)

    def predict(self, observations: Observations) -> Predictions:
        """Estimates for n frames.

        A touch changes the channels that determine the angle by more than a degree of bend does,
        so the angle of a touched frame is that of its dynamic reference, the sensor just before
        the touch: V/ref_bend over V/ref_touch is ref_touch/ref_bend.
        """
        flat = self.missing_static.fill(observations.static)
        free = self.missing_dynamic.fill(observations.dynamic)
        count = len(flat)
        unknown = np.full(count, np.nan)
        probabilities = (
            self.classifier.apply(flat) if self.classifier else np.full((count, len(State)), np.nan)
        )
        touched = most_probable(probabilities) == State.TOUCH
        untouched_dV = np.where(touched[:, None], (1 + flat) / (1 + free) - 1, flat)
        maps = np.full((count, *self.reconstruction.shape), np.nan, np.float32)
        if self.postprocessor:
            maps[~touched] = 0.0
            if touched.any():
                pictures = self.reconstruction.apply(free[touched])
                maps[touched] = self.postprocessor.apply(pictures)
        touches = (find_touches(touch_map, self.outline) for touch_map in maps)
        return Predictions(
            probabilities,
            self.bend_angle.apply(untouched_dV) if self.bend_angle else unknown,
            unknown,
            maps,
            tuple(FoundTouches.from_arrays(each[:, :2], each[:, 2]) for each in touches),
            ((),) * count,
        )

    @property
    def learning_curves(self) -> Mapping[str, LearningCurve]:
        """Losses of the networks in training, by their names."""
        networks = {"state classifier": self.classifier, "touch map": self.postprocessor}
        return {name: network.history for name, network in networks.items() if network}

    def adapt(self, known: KnownFrames) -> "tuple[PaperMethod, Adaptation]":
        """The method for one sensor: angles times the least-squares factor to the known angles.

        The paper has no calibration; a factor is what a regression through zero can learn from a
        few angles. The stated errors are the root mean squares over the frames at known angles.
        """
        bent = known[known.is_bent] if self.bend_angle is not None else known[:0]
        flat = int(known.flat.sum())
        adaptation = Adaptation(flat, len(bent), left_out=len(known) - flat - len(bent))
        if self.bend_angle is None or not len(bent):
            return self, adaptation
        estimated = self.bend_angle.apply(self.missing_static.fill(bent.observations.static))
        factor = float(estimated @ bent.angle_deg) / float(estimated @ estimated)
        before, after = (
            float(np.sqrt(np.mean((by * estimated - bent.angle_deg) ** 2))) for by in (1.0, factor)
        )
        errors = ((before,) * len(bent), (after,) * len(bent))
        calibration = Calibration(tuple(bent.angle_deg.tolist()), *errors, after)
        adapted = dataclasses.replace(self, bend_angle=self.bend_angle.times(factor))
        return adapted, dataclasses.replace(adaptation, calibration=calibration)

    def reconstructions(
        self, observations: Observations
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Reconstructions (n, rows, columns) with the static and with the dynamic reference."""
        static = self.reconstruction.apply(self.missing_static.fill(observations.static))
        dynamic = self.reconstruction.apply(self.missing_dynamic.fill(observations.dynamic))
        return static.astype(np.float32), dynamic.astype(np.float32)

    def outputs(self, observations: Observations) -> Arrays:
        """Outputs of every stage for n frames, each stage on its own; see `Method.outputs`."""
        static = self.missing_static.fill(observations.static)
        dynamic = self.reconstruction.apply(self.missing_dynamic.fill(observations.dynamic))
        outputs: dict[str, NDArray[np.generic]] = {"picture": dynamic}
        if self.classifier:
            outputs["probabilities"] = self.classifier.apply(static)
        if self.bend_angle:
            outputs["bend_angle_deg"] = self.bend_angle.apply(static)
        if self.postprocessor:
            outputs["touch_map"] = self.postprocessor.apply(dynamic)
        return outputs

    def arrays(self) -> Arrays:
        """Trained arrays of all stages; a stage without any was not trained."""
        return field_arrays(self)

    @classmethod
    def from_arrays(
        cls,
        arrays: Arrays,
        spec: InputSpec,
        settings: TrainingSettings | None = None,  # noqa: ARG003  the arrays say all
    ) -> "PaperMethod":
        shape = tuple(arrays["reconstruction.shape"].astype(int).tolist())
        parameters = {"outline": spec.outline, "classifier": {"shape": shape}}
        return cls(**restored_fields(cls, arrays, **parameters))


def _states(data: Dataset, static: Array) -> tuple[Array, NDArray[np.uint8]] | None:
    """dV (n, C) and states of the frames of known state; None without any."""
    is_known = data.state != UNKNOWN_STATE
    return (static[is_known], data.state[is_known]) if is_known.any() else None


def _touches(
    data: Dataset, dynamic: Array, spec: InputSpec
) -> tuple[Array, NDArray[np.float32]] | None:
    """dV (n, C) and true touch maps of the touched frames of known places; None without any."""
    placed = (data.state == State.TOUCH) & (data.touch_count > 0)
    if not placed.any():
        return None
    discs = (data.touch_x[placed], data.touch_y[placed], data.touch_radius[placed])
    return dynamic[placed], touch_maps(*discs, spec.outline, spec.pixels)


def _state_maps(
    reconstruction: Reconstruction,
    state: NDArray[np.uint8],
    static: Array,
    settings: TrainingSettings,
) -> list[Array]:
    """Linear maps that the classifier sees: the reconstruction and, if chosen, one without bends.

    A bend changes dV ten to fifty times more than a light touch on top of it; in the plain
    reconstruction such a touch is the last percent of the input.
    """
    maps = [reconstruction.matrix]
    idle, bend = (static[state == s] for s in (State.IDLE, State.BEND))
    if settings.bend_free_map and len(idle) and len(bend):
        idle_noise = float(np.sqrt(np.mean(idle**2)))
        maps.append(maps[0] @ bend_free_projection(bend, idle_noise))
    return maps
