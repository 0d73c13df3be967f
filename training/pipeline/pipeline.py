"""Perception pipeline: estimates from the frames of a session, training, calibration, saving."""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.bounds import require_axes
from eitskin.config import from_dict
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import State
from eitskin.errors import ConfigurationError, DataError
from eitskin.extras import old_names
from eitskin.frame import Frame
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.method.interface import Adaptation, Calibration, Method
from eitskin.training.method.known_frames import FrameLabel, KnownFrames, TwinPresses
from eitskin.training.method.observations import Observations, fingerprint, least_spread
from eitskin.training.method.predictions import Estimate, Predictions, Zero
from eitskin.training.method.sensor_health import ReadingRange, follow_recording
from eitskin.training.method.settings import (
    POSITIONS,
    Progress,
    TrainingSettings,
    silent,
    single_touches,
)
from eitskin.training.method.stored_fields import arrays_with_prefix, prefix_arrays
from eitskin.training.method.targets import Targets, with_implied_labels
from eitskin.training.pipeline.flat_sensors import FlatSensors
from eitskin.training.pipeline.methods import (
    FLAT_SENSORS,
    FOREIGN,
    USUAL,
    MethodCodeError,
    method_class,
    told_errors,
    trained_parts,
)
from eitskin.training.pipeline.references import StoredReference
from eitskin.training.pipeline.saved_form import (
    DAMAGE,
    SavedPipeline,
    read_pipeline,
    require_possible,
    write_pipeline,
)
from eitskin.training.pipeline.session import COMMON, Session


@old_names(expected="expected_magnitudes", followed="mark_failures", stored="stored_reference")
@dataclass(eq=False)
class Pipeline:
    """A trained perception method and the references of the current session.

    `process` takes the frames of a session in turn, `perceive` those of a dataset each on its own.

    Attributes:
        layout: sensor, measurements and frequency of the training frames.
        method: the trained method, which estimates frames one by one.
        noise: rms of the relative difference of two frames of a still sensor, dimensionless.
        settings: settings of the training.
        trained_on: SHA-256, source, and numbers of frames and specimens of the training set; those
            of version 0.1 do not count specimens.
        examples: a few training frames, by which a saved pipeline is checked.
        metrics: results of evaluations, as whoever evaluates writes them here.
        adaptation: result of `adapt`, as `Adaptation.as_dict` gives it; empty before.
        flat_sensors: distribution of flat, untouched sensors, by which a session's start is tested;
            None where training had too few specimens.
        usual: range of the readings of a healthy sensor, to detect failed electrodes; of a
            few frames where None is given.

    Example:
        >>> from eitskin import Pipeline, Scene, SensorDesign, Simulator
        >>> pipeline = Pipeline.load("reference.eitmodel")
        >>> frame = Simulator(SensorDesign.reference(), "coarse").measure(Scene())
        >>> pipeline.process(frame).state.name
        'IDLE'
    """

    layout: InputSpec
    method: Method
    noise: float
    settings: TrainingSettings
    trained_on: Mapping[str, Any]
    examples: Observations
    metrics: dict[str, Any] = field(default_factory=dict)
    adaptation: dict[str, Any] = field(default_factory=dict)
    flat_sensors: FlatSensors | None = None
    usual: ReadingRange | None = None

    def __post_init__(self) -> None:
        """A session without references."""
        if self.usual is None and self.settings.method != POSITIONS:
            self.usual = ReadingRange.fit(1.0 + self.examples.static, reference=True).widen()
        self.use(None)

    @classmethod
    def fit(
        cls,
        dataset: Dataset,
        settings: TrainingSettings | None = None,
        progress: Progress = silent,
        method: type[Method] | None = None,
    ) -> Self:
        """A pipeline trained on the training part of a dataset; `held_out` gives the test part.

        The pipeline estimates what the dataset has labels for (`targets`). Losses on the validation
        part select nothing. The result is reproducible with the same seed and torch threads.

        Args:
            dataset: frames of two states and more or at several bend angles, of a known design and
                protocol, with positions of touches where these are to be learned.
            settings: settings of the training; the defaults when omitted.
            progress: called with a stage, steps done and steps in all.
            method: your own method, instead of the one that the settings name.

        Raises:
            DataError: for a dataset without design or protocol, with positions alone, or with too
                few frames of a kind.
            ConfigurationError: for a method of your own whose predictions or arrays are wrong.
        """
        return cls(**trained_parts(dataset, settings or TrainingSettings(), progress, method))

    @property
    def targets(self) -> Targets:
        """Quantities that the pipeline estimates."""
        return self.method.targets

    def held_out(self, dataset: Dataset) -> NDArray[np.int64]:
        """Test frames (n,): the test part of the training set, all frames of another dataset.

        Touch positions are tested on frames with exactly one touch.
        """
        own = fingerprint(dataset) == self.trained_on["sha256"]
        if self.settings.method == POSITIONS:
            return single_touches(dataset)[self.trained_on["frames"] if own else 0 :]
        if own:
            return self.settings.split(with_implied_labels(dataset))[2]
        return np.arange(len(dataset))

    def adapt(
        self,
        frames: Sequence[Frame] | Dataset,
        labels: Sequence[FrameLabel] | None = None,
        twin: TwinPresses | None = None,
    ) -> Adaptation:
        """Adaptation to one sensor by frames of which it is known what they show.

        Each label shows what is known of its frame: a bend angle, touches with or without forces.
        The session begins again. An adaptation replaces the one before: give all frames at once.
        From now on sensors must resemble the flat frames to count as this one.

        Args:
            frames: n frames of one session, flat ones among them; or a dataset of one specimen.
            labels: one for each frame; a dataset has its own, and its own references.
            twin: `PressedTwin`, whose response is taken unless known touches contradict it.

        Raises:
            ConfigurationError, DataError, FrameError: for frames or labels that cannot be of one
                sensor, or a method that does not adapt; the pipeline is unchanged then.
        """
        self.method.require_adaptable()
        if isinstance(frames, Dataset):
            frames = self.mark_failures(frames)[0]
        known_frames = replace(KnownFrames.from_frames(frames, labels, self.layout), twin=twin)
        adapted, adaptation = self.method.adapt(known_frames)
        adaptation.require_fit(known_frames)
        self.method, self.adaptation = adapted, adaptation.as_dict()
        self.layout = self.layout.for_sensor(flat := known_frames.observations.flat[0])
        self.flat_sensors = self.flat_sensors and self.flat_sensors.for_sensor(flat)
        self.reset()
        return adaptation

    def calibrate(self, frames: Sequence[Frame], angles_deg: ArrayLike) -> Calibration:
        """Adaptation to one sensor by untouched frames at known bend angles.

        Five angles over the range suffice; several frames at each reduce the error.

        Args:
            frames: n untouched frames of the sensor.
            angles_deg: their bend angles (n,) [deg], 0 among them.

        Raises:
            ConfigurationError, DataError, FrameError: for frames or angles that cannot calibrate,
                or a pipeline that does not estimate the angle; the pipeline is unchanged then.
        """
        self.require_bends()
        labels = [FrameLabel(angle) for angle in np.ravel(angles_deg).astype(float).tolist()]
        if all(label.flat for label in labels):
            raise ConfigurationError(
                f"expected a frame of the bent sensor to calibrate by, got {len(labels)} flat ones"
            )
        calibration = self.adapt(frames, labels).calibration
        if calibration is None:
            raise ConfigurationError(f"'{self.method.KIND}' does not learn from known angles")
        return calibration

    @property
    def calibration(self) -> dict[str, Any]:
        """Errors of the angle, as `Calibration.as_dict` gives them; empty without known angles."""
        return dict(self.adaptation.get("calibration") or {})

    def require_bends(self) -> None:
        """Refuse a pipeline that does not estimate the angle; raises ConfigurationError."""
        if not self.targets.angle:
            raise ConfigurationError(
                "expected a pipeline that estimates the bend angle, got one trained without bends; "
                "train it on frames at known angles"
            )

    @property
    def expected_magnitudes(self) -> NDArray[np.float64] | None:
        """Magnitudes (measurements,) [ohm] of the sensor as its session begins; None if unknown."""
        usual = self.layout.reference
        size = usual if self.stored_reference is None else self.stored_reference.magnitudes(usual)
        return size if np.isfinite(size).all() else None

    @property
    def references(self) -> Session:
        """Session with its static (`bend`) and dynamic reference (`touch`)."""
        return self._session

    @property
    def stored_reference(self) -> StoredReference | None:
        """Stored reference in use; None where a session's first frames are the zero."""
        return self._session.stored

    def tare(
        self, frames: Sequence[Frame], zero: Zero = Zero.FLAT, board: str = "", source: str = ""
    ) -> StoredReference:
        """A stored reference from untouched frames of one sensor, which is used from now on.

        Args:
            frames: frames of the still, untouched sensor.
            zero: `Zero.FLAT`, or `Zero.MOUNTED` for a sensor mounted on a curved body: its shape
                there is then the zero of the bend angle.
            board: unique number of the board in hexadecimal digits, where known.
            source: source of the frames, where known.

        Raises:
            ConfigurationError: for no frames.
            FrameError: for a frame of another sensor, table or frequency, or with too few good
                channels.
            DataError: for a sensor that moves, or, with `Zero.FLAT`, does not look flat and
                untouched. The pipeline is unchanged then, as after the other errors.
        """
        voltages = [self.layout.voltages(frame)[0] for frame in frames]
        if not voltages:
            raise ConfigurationError("expected frames of the untouched sensor, got none; give some")
        reference = StoredReference.from_frames(
            voltages, frames[0].protocol, frames[0].frequency, zero, self.noise, board, source
        )
        self.layout.require_same_sensor(reference.impedance)
        if zero is Zero.FLAT and (doubt := self.doubt(reference.impedance)):
            raise DataError(
                f"{doubt}; straighten and release it, or, where its shape now is to be the zero, "
                "take the reference as mounted (--mounted)"
            )
        self.use(reference)
        return reference

    def use(self, reference: StoredReference | None) -> None:
        """Use a stored reference as the zero of all estimates; None for a session's first frames.

        The session begins again. Raises FrameError for a reference of another sensor, table or
        frequency.
        """
        if reference is not None:
            self.layout.require_same_measurements(reference.protocol, reference.frequency)
            self.layout.require_same_sensor(reference.impedance)
        bends = self.targets.angle or "bend" in self.targets.states
        scales = self.method.noise_scale, min(COMMON, 0.5 * least_spread(self.examples))
        self._session = Session(
            self.noise, self.method.AVERAGES, reference, bends, *scales, self.usual
        )

    def doubt(self, impedance: ArrayLike) -> str:
        """Reason why an impedance (measurements,) [ohm] is not that of a flat, untouched sensor.

        Empty where it may be, or where the pipeline has no `flat_sensors` to compare with.
        """
        values = np.asarray(impedance)
        require_axes("impedance", values, len(self.layout.reference), more=False)
        return "" if self.flat_sensors is None else self.flat_sensors.judge(values).doubt

    def reset(self) -> None:
        """Begin a new session.

        Its first frame must be of the flat, untouched sensor unless a stored reference is in use.
        """
        self.use(self.stored_reference)

    def process(self, frame: Frame) -> Estimate:
        """The estimate for the next frame of a session.

        Without a stored reference the first frame becomes the static and the dynamic reference:
        the sensor must then be flat and untouched. Up to 32 further such frames are averaged into
        the references. Where the first frame is implausible for a flat, untouched sensor, angle,
        idle and bend are unknown throughout the session, and `problems` says so. New sessions
        and faults of number and time are reported; `SessionOrder` has the rules.

        Raises:
            FrameError: for a frame of another sensor, table or frequency, with too few good
                channels, or most of reversed sign; the references are unchanged then.
        """
        voltages, problems = self.layout.voltages(frame)
        session = self._session
        problems += session.follow(frame)
        first = session.empty
        try:
            if first:
                self.layout.require_same_sensor(voltages)
                session.average(voltages)
                session.doubt = self.doubt(voltages)
            voltages, stepped = session.without_gain_step(voltages)
            voltages = session.with_same_sign(voltages)
            voltages, failed = session.without_failed(frame, voltages)
            perceived = self.method.predict(observed := session.to_observations(voltages))
        except Exception:
            if first:
                session.begin()
            raise
        if not perceived.is_touched(self.targets) and (
            hidden := session.with_hidden(voltages, observed)
        ):
            perceived, observed = self.method.predict(hidden), hidden
        perceived = session.with_lag(perceived)
        if (touched := perceived.is_touched(self.targets)) or not first:
            along = self.method.motions(observed, perceived) if touched else None
            chance, explained = perceived.probabilities[0, State.TOUCH], not perceived.problems[0]
            session.renew(voltages, touched, chance, along, explained)
        problems += (
            *stepped,
            *failed,
            *perceived.problems[0],
            *session.problems(frame.protocol.labels),
        )
        estimate = Estimate.from_predictions(perceived, self.targets, problems, frame, session.zero)
        if session.doubt:
            return estimate.for_unknown_start()
        if session.zero is Zero.MOUNTED and not self.calibration:
            return replace(estimate, bend_deviation_deg=None)  # trained on bends of flat sensors
        return estimate

    def mark_failures(self, dataset: Dataset) -> tuple[Dataset, tuple[str, ...]]:
        """Dataset with the channels of electrodes marked that failed in it, and these in words."""
        marked, faults = follow_recording(dataset, self.usual)
        return marked, tuple(map(str, faults))

    def perceive(self, dataset: Dataset) -> Predictions:
        """Estimates for all frames of a dataset, each on its own, without electrodes that failed.

        The static reference of a frame is its specimen's flat reference, the dynamic one its own
        `touch_reference`. The session of `process` is unchanged.
        """
        return self.method.predict(Observations.from_dataset(self.mark_failures(dataset)[0]))

    def save(self, path: str | Path) -> Path:
        """Write the folder NAME.eitmodel, replacing a pipeline there; returns its path.

        Raises ConfigurationError for another ending or a path that is no pipeline, and
        PartialError where the folder cannot be written.
        """
        outputs = self.method.outputs(self.examples)
        golden = prefix_arrays("input", self.examples.arrays()) | prefix_arrays("output", outputs)
        weights = dict(self.method.arrays())
        if np.isfinite(self.layout.reference).any():
            weights["layout.reference"] = self.layout.reference
        if self.flat_sensors is not None:
            weights |= prefix_arrays(FLAT_SENSORS, self.flat_sensors.arrays())
        if self.usual is not None:
            weights |= prefix_arrays(USUAL, self.usual.arrays())
        document = {
            "method": self.method.KIND,
            "layout": self.layout.document(),
            "noise": self.noise,
            "settings": asdict(self.settings),
            "estimates": self.targets.as_dict(),
            "trained_on": dict(self.trained_on),
            "metrics": self.metrics,
            "adaptation": self.adaptation,
        }
        return write_pipeline(path, SavedPipeline(document, weights, golden))

    @classmethod
    def load(cls, path: str | Path, method: type[Method] | None = None) -> Self:
        """A saved pipeline, checked by the outputs that were saved with it.

        "reference.eitmodel", unless a folder of that name exists, is that of the reference sensor.

        Args:
            path: path of the folder.
            method: code of the method of your own that the pipeline was trained with; opening a
                pipeline runs no other.

        Raises:
            ConfigurationError: for a pipeline of a custom method without its code, or with other
                code.
            DataError: for one that is damaged, changed, impossible, too new, or computes otherwise.
        """
        saved = read_pipeline(path)
        try:
            document, weights = saved.document, saved.weights
            noise = require_possible(weights, saved.golden, document.get("noise"))
            settings = from_dict(
                TrainingSettings, {"whole_touches": False} | document["settings"], "settings"
            )
            examples = Observations.from_arrays(arrays_with_prefix("input", saved.golden))
            positions = document["method"] == POSITIONS
            reference = examples.flat[0] if positions else weights["layout.reference"]
            layout = InputSpec.from_document(document["layout"], reference)
            arrays = {n: array for n, array in weights.items() if not n.startswith(FOREIGN)}
            flat, usual = (arrays_with_prefix(name, weights) for name in (FLAT_SENSORS, USUAL))
            code = method_class(document["method"], method)
            with nullcontext() if method is None else told_errors(code.KIND):
                restored = code.from_arrays(arrays, layout, settings)
                outputs = restored.outputs(examples)
            pipeline = cls(
                layout,
                restored,
                noise,
                settings,
                dict(document["trained_on"]),
                examples,
                dict(document["metrics"]),
                saved.adaptation,
                FlatSensors.from_arrays(flat) if flat else None,
                ReadingRange.from_arrays(usual) if usual else None,
            )
            saved.require_golden(outputs, restored.FITTED)
        except (DataError, MethodCodeError):
            raise
        except DAMAGE as error:
            raise DataError(f"{path} is not whole: {error}; save the pipeline again") from error
        return pipeline


def open_pipeline(path: str | Path, method: type[Method] | None = None) -> Pipeline:
    """`Pipeline.load`: a saved pipeline, whose `targets` shows what its estimates hold.

    Example:
        >>> from eitskin.training import open_pipeline
        >>> open_pipeline("reference.eitmodel").targets.missing
        ()
    """
    return Pipeline.load(path, method)
