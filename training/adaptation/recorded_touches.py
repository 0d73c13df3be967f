"""Touch positions learned from a recording without geometry: training, scoring and saving."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from eitskin.config import from_dict, to_dict
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import State
from eitskin.errors import ConfigurationError, DataError, FrameError
from eitskin.frame import Frame
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol
from eitskin.training.adaptation.labelled_presses import LabelledPresses, single_touches
from eitskin.training.adaptation.position_regressor import PositionRegressor
from eitskin.training.adaptation.press_fit import learn_places
from eitskin.training.adaptation.press_locator import PressLocator
from eitskin.training.method.input_spec import FREQUENCY_TOLERANCE, usable_values
from eitskin.training.method.observations import fingerprint
from eitskin.training.method.predictions import FoundTouches
from eitskin.training.method.targets import Targets
from eitskin.training.pipeline.estimate import Estimate
from eitskin.training.pipeline.model_card import position_card
from eitskin.training.pipeline.references import References
from eitskin.training.pipeline.saved_checks import DAMAGE, require_possible
from eitskin.training.pipeline.saved_form import (
    SavedPipeline,
    read_pipeline,
    require_kind,
    write_pipeline,
)
from eitskin.training.pipeline.stored_reference import StoredReference, Zero

STILL = 0.1  # rms change of a still sensor, relative to that of the usual touch; see `References`
WEAKEST = 0.2  # of the usual touch; the direction of a smaller change is mostly noise
TRAINING_SHARE = 0.8  # the first part in time; neighbours in time are too similar to test on
GOLDEN = 5


@dataclass(frozen=True, slots=True)
class PositionScore:
    """Errors of estimated positions.

    Attributes:
        frames: number of frames.
        mean_error_mm, median_error_mm: mean and median distance from the true position [mm].
        guess_error_mm: mean distance of the mean training position from the true one [mm].
    """

    frames: int
    mean_error_mm: float
    median_error_mm: float
    guess_error_mm: float

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return asdict(self)


@dataclass(eq=False)
class RecordedTouches:
    """Touch positions learned from a recording of one sensor, and the reference of a session.

    `evaluate` takes the frames of a dataset, each with its own reference, `process` those of a
    session one after another. Neither state nor bend angle nor force is estimated.

    Attributes:
        position: from ratios |V / ref| to positions; a regressor in pipelines of version 0.1.
        examples: ratios by which a saved copy is checked (k, channels).
        trained_on: fingerprint of the recording and number of frames trained with.
        protocol: of the recording's frames; None where unknown.
        metrics: results of an evaluation, written by the evaluating code.
        frequency: of the excitation [Hz]; not known without a protocol.
        design: of the sensor; None where the recording has none.
        stored: stored reference in use; None where a session's first frames are the zero.
        extent: smallest and largest x and y of the positions trained with (2, 2) [m]; None in
            pipelines of version 0.1.
    """

    KIND: ClassVar[str] = "touch position"

    position: PressLocator | PositionRegressor
    examples: NDArray[np.float64]
    trained_on: Mapping[str, Any]
    protocol: Protocol | None = None
    metrics: dict[str, Any] = field(default_factory=dict)
    frequency: float = math.nan
    design: SensorDesign | None = None
    extent: NDArray[np.float64] | None = None
    stored: StoredReference | None = field(init=False, repr=False, default=None)
    references: References = field(init=False, repr=False)
    _last: Frame | None = field(init=False, repr=False, default=None)

    def __post_init__(self) -> None:
        """A session without a reference."""
        self.use(None)

    @property
    def targets(self) -> Targets:
        """Quantities that are estimated: positions alone."""
        return Targets((), angle=False, force=False)

    @classmethod
    def fit(cls, dataset: Dataset, share: float = TRAINING_SHARE) -> "RecordedTouches":
        """Learn from the first frames in time of those that have exactly one touch.

        Depths or forces are used where all of these frames have them; design and protocol where the
        dataset has them.

        Args:
            dataset: labelled frames of one sensor.
            share: of the frames that is learned from; with 1 none is left to `evaluate` by.

        Raises DataError for fewer than 5 presses.
        """
        touches = single_touches(dataset)
        train = touches[: round(share * len(touches))]
        presses = LabelledPresses.of(dataset, train)
        ratios, places = presses.ratios, presses.places
        learned = learn_places(presses)
        trained_on = {
            "sha256": fingerprint(dataset),
            "frames": len(train),
            "source": dataset.source,
            "law": None if learned.law is None else asdict(learned.law),
            "choice": asdict(learned.choice),
            "validated": asdict(learned.validated),
        }
        return cls(
            learned.locator,
            ratios[:GOLDEN],
            trained_on,
            dataset.protocol,
            frequency=dataset.frequency if dataset.protocol else math.nan,
            design=dataset.design,
            extent=np.array([places.min(axis=0), places.max(axis=0)]),
        )

    def described(self, dataset: Dataset) -> Dataset:
        """Dataset of another recording with this one's design and protocol, where it has none.

        Raises FrameError for other measurements.
        """
        protocol = dataset.protocol or self.protocol
        if protocol is not None:
            self.require_same_measurements(protocol, dataset.frequency)
        return replace(dataset, protocol=protocol, design=dataset.design or self.design)

    @property
    def still(self) -> float:
        """Largest rms relative difference of two frames of a still, untouched sensor."""
        return STILL * float(np.sqrt(np.mean(self.position.channel_scale**2)))

    def use(self, reference: StoredReference | None) -> None:
        """Use a stored reference as the zero of all estimates; None for a session's first frames.

        The session begins anew. Raises FrameError for a reference of other measurements.
        """
        if reference is not None:
            self.require_same_measurements(reference.protocol, reference.frequency)
        self.stored = reference
        values, frames = (reference.impedance, reference.frames) if reference else (None, 0)
        self.references = References(self.still, values, frames)
        self._last = None

    def tare(
        self, frames: Sequence[Frame], zero: Zero = Zero.FLAT, board: str = "", source: str = ""
    ) -> StoredReference:
        """A stored reference from untouched frames of the sensor, which is used from now on.

        Positions are relative to the shape in which the sensor was taken; whether that was flat is
        not judged. Arguments as for `Pipeline.tare`.

        Raises:
            ConfigurationError: for no frames.
            FrameError: for a frame with other measurements, or with too few good channels.
            DataError: for a sensor that moves.
        """
        if not len(frames):
            raise ConfigurationError("expected frames of the untouched sensor, got none; give some")
        for frame in frames:
            self.require_same_measurements(frame.protocol, frame.frequency)
        voltages, first = [usable_values(frame)[0] for frame in frames], frames[0]
        reference = StoredReference.of(
            voltages, first.protocol, first.frequency, zero, self.still, board, source
        )
        self.use(reference)
        return reference

    def reset(self) -> None:
        """Begin a new session; its first frame must be of the untouched sensor."""
        self.references.drop()
        self._last = None

    def process(self, frame: Frame) -> Estimate:
        """The estimate for the next frame of a session: the position of one touch.

        Without a stored reference the first frame becomes it: the sensor must then be untouched,
        in the shape in which it will be touched. Up to 32 further frames that change by less than a
        fifth of the usual touch are averaged into it. A later frame that changes by less has no
        touch; whether a frame that changes by more is touched is not known. A frame of
        another session, or a number or time that runs backwards, begins a new session.

        Raises:
            FrameError: for a frame with other measurements; the session is unchanged then.
            UnusableFrameError: for a frame with too few good channels.
        """
        self.require_same_measurements(frame.protocol, frame.frequency)
        voltages, problems = usable_values(frame)
        last = self._last
        if last and (
            frame.session != last.session or frame.number < last.number or frame.time < last.time
        ):
            self.reset()
        self.references.follow(voltages)
        self._last = frame
        with np.errstate(invalid="ignore"):  # NaN marks a bad channel
            ratio = np.abs(voltages / self.references.bend)[None]
        strength = self.position.strength(ratio)
        found = FoundTouches.of(np.zeros((0, 2)), [])
        if strength[0] >= WEAKEST:
            located, left_out = self.position.locate(ratio)
            found = FoundTouches.of(
                located.place, np.minimum(strength, 1.0), deviation=located.deviation
            )
            misfits = left_out[0] & np.isfinite(ratio[0])
            problems += tuple(
                f"channel {label} departs from what all others say and is left out"
                for label, misfit in zip(frame.protocol.labels, misfits, strict=True)
                if misfit
            )
        unknown = np.full(len(State), np.nan)
        zero = Zero.FIRST_FRAMES if self.stored is None else self.stored.zero
        return Estimate(
            None, unknown, None, None, None, tuple(found), problems, frame.number, frame.time, zero
        )

    def require_same_measurements(self, protocol: Protocol, frequency: float) -> None:
        """Refuse other measurements than the recording's; raises FrameError."""
        try:
            self.position.require_channels(len(protocol))
        except DataError as error:
            raise FrameError(str(error)) from error
        if self.protocol is not None:
            self.protocol.require_same(
                protocol,
                "these touch positions were learned from",
                "the frame has",
                "set the board to the first",
            )
        if abs(frequency / self.frequency - 1.0) > FREQUENCY_TOLERANCE:
            raise FrameError(
                f"these touch positions were learned at {self.frequency:g} Hz, the frame was "
                f"measured at {frequency:g} Hz; set the board to that frequency"
            )

    def held_out(self, dataset: Dataset) -> NDArray[np.int64]:
        """Frames (n,) not trained with: the last of the own recording, all of another.

        Raises FrameError for a dataset of another protocol, where both are known.
        """
        if self.protocol is not None and dataset.protocol is not None:
            self.protocol.require_same(
                dataset.protocol,
                "these touch positions were learned from frames of",
                "the dataset has",
                "train on recordings of this protocol",
            )
        touches = single_touches(dataset)
        own = fingerprint(dataset) == self.trained_on["sha256"]
        return touches[self.trained_on["frames"] :] if own else touches

    def found(self, dataset: Dataset) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """True and estimated positions in the held-out frames of `dataset`, (k, 2) [m] each.

        Raises DataError where no frame is held out.
        """
        frames = self.held_out(dataset)
        if len(frames) == 0:
            raise DataError(
                "expected frames with exactly one touch to evaluate on, got none; record more"
            )
        presses = LabelledPresses.of(dataset, frames)
        return presses.places, self.position.apply(presses.ratios)

    def evaluate(self, dataset: Dataset) -> PositionScore:
        """Score on the held-out frames of `dataset`; raises DataError where there are none."""
        truth, found = self.found(dataset)
        error = np.linalg.norm(found - truth, axis=1)
        guess = np.linalg.norm(self.position.centre - truth, axis=1)
        return PositionScore(
            len(truth),
            float(error.mean()) * 1e3,
            float(np.median(error)) * 1e3,
            float(guess.mean()) * 1e3,
        )

    def save(self, path: str | Path) -> Path:
        """Write the folder NAME.eitmodel, replacing an existing one; returns its path."""
        document = {
            "channels": self.examples.shape[1],
            "units": {"ratio": "1", "place": "m"},
            "estimates": self.targets.as_dict(),
            "protocol": None if self.protocol is None else asdict(self.protocol),
            "frequency": None if math.isnan(self.frequency) else self.frequency,
            "design": None if self.design is None else to_dict(self.design),
            "extent": None if self.extent is None else self.extent.tolist(),
            "trained_on": dict(self.trained_on),
            "metrics": self.metrics,
        }
        golden = {
            "input.ratio": self.examples,
            "output.place": self.position.apply(self.examples),
        }
        weights = self.position.arrays()
        return write_pipeline(
            path, SavedPipeline(self.KIND, document, weights, golden, position_card(document))
        )

    @classmethod
    def load(cls, path: str | Path) -> "RecordedTouches":
        """Read a saved folder; raises DataError where it is damaged or computes otherwise."""
        saved = read_pipeline(path)
        require_kind(saved, cls.KIND, path)
        try:
            require_possible(saved.weights, saved.golden)
            arrays = dict(saved.weights)
            kind = PositionRegressor if "directions" in arrays else PressLocator
            position = kind.from_arrays(arrays)
            document, examples = saved.document, saved.golden["input.ratio"]
            protocol, frequency, design, extent = (
                document.get(name) for name in ("protocol", "frequency", "design", "extent")
            )
            loaded = cls(
                position,
                examples,
                document["trained_on"],
                protocol and from_dict(Protocol, protocol, "protocol"),
                dict(document["metrics"]),
                math.nan if frequency is None else float(frequency),
                design and from_dict(SensorDesign, design, "design"),
                extent and np.array(extent),
            )
            saved.require_golden({"place": position.apply(examples)})
        except DataError:
            raise
        except DAMAGE as error:
            raise DataError(f"{path} is not whole: {error}; save it again") from error
        return loaded
