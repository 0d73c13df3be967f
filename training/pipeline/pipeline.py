"""The perception pipeline: from frames, one after another, to what the skin feels."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.config import from_dict
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.state import State
from eitskin.errors import DataError
from eitskin.frame import Frame
from eitskin.training.method.calibration import Calibration, KnownBends
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.method.interface import Method
from eitskin.training.method.observations import (
    Observations,
    fingerprint,
    frame_noise,
    relative_difference,
)
from eitskin.training.method.predictions import FoundTouches, Predictions
from eitskin.training.method.settings import Progress, TrainingSettings, silent
from eitskin.training.pipeline.methods import fit_method, method_from_arrays
from eitskin.training.pipeline.model_card import perception_card
from eitskin.training.pipeline.references import References, RunningMean, Voltages
from eitskin.training.pipeline.saved_form import (
    SavedPipeline,
    read_pipeline,
    require_kind,
    write_pipeline,
)

KIND = "perception"
LONGEST_HELD = 8  # frames of a held touch that are averaged; longer would lag behind its creep
LONGEST_GAP = 5.0  # s without frames after which the dynamic reference may be out of date
GOLDEN_PER_STATE = 2


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """What the skin feels in one frame.

    Attributes:
        state: idle, touched or bent; a bent sensor that is touched is touched.
        probabilities: of the three states, in the order of `State`, (3,).
        bend_angle_deg: [deg]; the paper's method gives, while touched, that of the sensor just
            before the touch.
        bend_deviation_deg: its standard error [deg]; NaN where the method does not say.
        touch_map: probability of each pixel to be touched, (rows, columns), 0 to 1; rows and
            columns grow with y and x. Zero unless the state is touch.
        found: the touches, with their forces and standard errors where the method gives them.
        problems: what is wrong with the frame, in words; empty when all is well.
        number: of the frame.
        time: of the frame [s].
    """

    state: State
    probabilities: NDArray[np.float64]
    bend_angle_deg: float
    bend_deviation_deg: float
    touch_map: NDArray[np.float32]
    found: FoundTouches
    problems: tuple[str, ...]
    number: int
    time: float

    @property
    def touches(self) -> tuple[tuple[float, float, float], ...]:
        """x [m], y [m] and strength, 0 to 1, of each touch, strongest first."""
        return self.found.triples


@dataclass(eq=False)
class Pipeline:
    """Trained stages, and the references of the session that they are applied to.

    Attributes:
        layout: what it was trained for.
        method: that says what a frame shows, and remembers nothing.
        noise: rms of the relative difference of two frames of a still sensor.
        settings: how it was trained.
        trained_on: fingerprint and split of the training set.
        examples: a few training frames that a saved pipeline is checked with.
        metrics: how good it was found to be; whoever evaluates it writes them here.
        calibration: what adapting it to one sensor did, as `Calibration` says; empty before.
    """

    layout: InputSpec
    method: Method
    noise: float
    settings: TrainingSettings
    trained_on: Mapping[str, Any]
    examples: Observations
    metrics: dict[str, Any] = field(default_factory=dict)
    calibration: dict[str, Any] = field(default_factory=dict)
    references: References = field(init=False, repr=False)
    _last: Frame | None = field(init=False, repr=False, default=None)
    _outdated: bool = field(init=False, repr=False, default=False)
    _held: RunningMean = field(init=False, repr=False)
    _touched: bool = field(init=False, repr=False, default=False)
    _begun: float = field(init=False, repr=False, default=0.0)
    _renewed: float = field(init=False, repr=False, default=0.0)

    def __post_init__(self) -> None:
        """Begin without references."""
        self.references = References(self.noise)
        self._held = RunningMean(self.noise, longest=LONGEST_HELD)

    @classmethod
    def fit(
        cls,
        dataset: Dataset,
        settings: TrainingSettings | None = None,
        progress: Progress = silent,
    ) -> "Pipeline":
        """Train on the first part of the dataset's split; `held_out` gives the last.

        The losses on the part between them are told beside those of training; nothing is chosen
        by them.

        One machine, one seed, one number of torch threads: the same pipeline.

        Raises DataError where the dataset says too little to train on.
        """
        settings = settings or TrainingSettings()
        if dataset.design is None or dataset.protocol is None:
            raise DataError(
                "a perception pipeline needs a dataset that knows its sensor's geometry and table "
                "of measurements; of this one only touch positions can be learned"
            )
        seen, unseen, _ = dataset.split(settings.fractions, settings.seed)
        train, validation = dataset.select(seen), dataset.select(unseen)
        specimens = np.unique(train.specimen)
        reference = np.median(np.abs(dataset.reference[specimens]), axis=0).astype(float)
        layout = InputSpec(dataset.design, dataset.protocol, dataset.frequency, reference)
        observations = Observations.of(train)
        chosen = np.concatenate(
            [np.flatnonzero(train.state == state)[:GOLDEN_PER_STATE] for state in State]
        )
        return cls(
            layout,
            fit_method(train, layout, settings, progress, validation),
            frame_noise(train, observations),
            settings,
            {"sha256": fingerprint(dataset), "frames": len(train), "source": dataset.source},
            observations[chosen],
        )

    def held_out(self, dataset: Dataset) -> NDArray[np.int64]:
        """Frames (n,) that training never saw: the test part of its own dataset, all of another."""
        if fingerprint(dataset) == self.trained_on["sha256"]:
            return dataset.split(self.settings.fractions, self.settings.seed)[2]
        return np.arange(len(dataset))

    def calibrate(self, frames: Sequence[Frame], angles_deg: ArrayLike) -> Calibration:
        """Adapt to one sensor, from untouched frames at known angles (n,) [deg], 0 among them.

        Five angles over the range do; several frames of each make it better. The session begins
        anew. Calibrate the pipeline that was trained, not one that was calibrated before.

        Raises ConfigurationError, DataError or FrameError for frames that will not do; then
        nothing has changed.
        """
        known = KnownBends.of(frames, angles_deg, self.layout)
        adapted, calibration = self.method.adapted(known)
        calibration.require_fit(known)
        self.method = adapted
        self.calibration = calibration.as_dict()
        self.reset()
        return calibration

    def reset(self) -> None:
        """Forget the session; the next frame must be of the flat, untouched sensor."""
        self.references.drop()
        self._held = RunningMean(self.noise, longest=LONGEST_HELD)
        self._last, self._outdated, self._touched = None, False, False

    def process(self, frame: Frame) -> Estimate:
        """The estimate for the next frame of a session.

        The first frame becomes both references: the sensor must be flat and untouched then. Stay
        so for some frames and the references become better, up to 32. A new session, or a number
        or time that runs backwards, begins again.

        Raises FrameError for a frame of another sensor, table or frequency, or with too few good
        channels; such a frame changes nothing.
        """
        voltages, problems = self.layout.voltages(frame)
        self._notice_session(frame)
        references = self.references
        first = references.empty
        if first:
            self.layout.require_same_sensor(voltages)
            references.follow(voltages)
            self._begun = self._renewed = frame.time
        held, count = self._held_touch(voltages)
        perceived = self.method.perceive(self._observed(held, count, frame))
        state = State(int(perceived.state[0]))
        self._touched = state is State.TOUCH
        if state is State.TOUCH:
            references.freeze()
        elif not first:
            references.follow(voltages)
            self._outdated, self._renewed = False, frame.time
        self._last = frame
        return Estimate(
            state=state,
            probabilities=perceived.probabilities[0],
            bend_angle_deg=float(perceived.bend_angle_deg[0]),
            bend_deviation_deg=float(perceived.bend_deviation_deg[0]),
            touch_map=perceived.touch_map[0],
            found=perceived.touches[0],
            problems=(*problems, *perceived.problems[0], *self._reference_problems(state)),
            number=frame.number,
            time=frame.time,
        )

    def perceive(self, dataset: Dataset) -> Predictions:
        """What each frame of a dataset shows, by itself.

        Each is compared with its specimen's flat reference and its own `touch_reference`, which is
        what the dynamic reference of a session would hold; this session's are left alone.
        """
        return self.method.perceive(Observations.of(dataset))

    def _held_touch(self, voltages: Voltages) -> tuple[Voltages, int]:
        """The mean of the frames since a touch is held unchanged, and their number; else the frame.

        A touch that stays where it is says the same in every frame, but for noise. Untouched
        frames are not averaged: an angle would lag behind a slow bend.
        """
        departed = self._held.add(voltages)
        if self.method.AVERAGES and self._touched and not departed and self._held.mean is not None:
            return np.where(np.isfinite(voltages), self._held.mean, np.nan), self._held.count
        self._held.restart(voltages)
        return voltages, 1

    def _observed(self, voltages: Voltages, count: int, frame: Frame) -> Observations:
        """A frame of the session, or the mean of some, beside the references."""
        references = self.references
        rows = {
            "static": relative_difference(voltages, references.bend),
            "dynamic": relative_difference(voltages, references.touch),
            "flat": np.abs(references.bend),
            "frames": float(count),
            "static_frames": float(references.bend_frames),
            "dynamic_frames": float(references.touch_frames),
            "age": frame.time - self._begun,
            "dynamic_age": frame.time - self._renewed,
        }
        return Observations(**{name: np.asarray(value)[None] for name, value in rows.items()})

    def _notice_session(self, frame: Frame) -> None:
        """Begin again with a new session; notice that no frames came for long."""
        last = self._last
        if last is None:
            return
        if frame.session != last.session or frame.number < last.number or frame.time < last.time:
            self.reset()
        elif frame.time - last.time > LONGEST_GAP:
            self._outdated = True

    def _reference_problems(self, state: State) -> tuple[str, ...]:
        problems = []
        for i in np.flatnonzero(~np.isfinite(self.references.bend)):
            label = self.layout.protocol.labels[i]
            problems.append(f"channel {label} is left out: it was bad when the session began")
        if self._outdated and state is State.TOUCH:
            problems.append(
                f"no frames came for more than {LONGEST_GAP:g} s before this touch: its place is "
                "wrong where the sensor has been bent since"
            )
        return tuple(problems)

    def save(self, path: str | Path) -> Path:
        """Write the pipeline as the folder NAME.eitmodel; a pipeline there is replaced."""
        outputs = self.method.outputs(self.examples)
        golden: dict[str, NDArray[Any]] = {
            f"input.{name}": array for name, array in self.examples.arrays().items()
        }
        golden |= {f"output.{name}": array for name, array in outputs.items()}
        weights = {**self.method.arrays(), "layout.reference": self.layout.reference}
        document = {
            "method": self.method.KIND,
            "layout": self.layout.document(),
            "noise": self.noise,
            "settings": asdict(self.settings),
            "trained_on": dict(self.trained_on),
            "metrics": self.metrics,
            "calibration": self.calibration,
        }
        saved = SavedPipeline(KIND, document, weights, golden, perception_card(document))
        return write_pipeline(path, saved)

    @classmethod
    def load(cls, path: str | Path) -> "Pipeline":
        """Read a saved pipeline and check that it computes here what it did when it was saved.

        "reference.eitmodel", where no such folder is, is the pipeline that comes with eitskin,
        trained on the recipe `training` for the reference sensor.

        Raises DataError where it is damaged, changed, newer than this eitskin, or does not.
        """
        saved = read_pipeline(path)
        require_kind(saved, KIND, path)
        try:
            document, weights = saved.document, saved.weights
            layout = InputSpec.from_document(document["layout"], weights["layout.reference"])
            inputs = {name: saved.golden[f"input.{name}"] for name in Observations.__slots__}
            pipeline = cls(
                layout,
                method_from_arrays(document["method"], weights, layout),
                float(document["noise"]),
                from_dict(TrainingSettings, document["settings"], "settings"),
                dict(document["trained_on"]),
                Observations(**inputs),
                dict(document["metrics"]),
                dict(document.get("calibration", {})),
            )
            saved.require_golden(pipeline.method.outputs(pipeline.examples))
        except DataError:
            raise
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise DataError(f"{path} is not whole: {error}; save the pipeline again") from error
        return pipeline
