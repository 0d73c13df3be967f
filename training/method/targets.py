"""Targets of learning: what a dataset has labels for, and the frames that a method is fitted to."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets import UNKNOWN_STATE, Dataset, State
from eitskin.extras import old_names
from eitskin.geometry import DataError, SensorDesign
from eitskin.simulator import Protocol
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.method.known_frames import FLAT_DEG
from eitskin.training.method.observations import Observations, frame_noise

NOMINAL_RADIUS = 0.0075  # m, of indenters whose radius no frame shows; the paper's cylinder


STATE_NAMES = tuple(state.name.lower() for state in State)


@old_names(of="from_dataset", shared_with="intersection")
@dataclass(frozen=True, slots=True)
class Targets:
    """Quantities that frames have labels for, or that a method estimates.

    Attributes:
        states: names of the states that are distinguished, in the order of `State`; empty, or two
            and more.
        angle: whether the bend angle is one.
        touches: whether positions of touches are.
        force: whether forces of touches are.

    Example:
        >>> from eitskin.training import Targets
        >>> Targets(angle=False).missing
        ('the bend angle',)
    """

    states: tuple[str, ...] = STATE_NAMES
    angle: bool = True
    touches: bool = True
    force: bool = True

    @classmethod
    def from_dataset(cls, dataset: Dataset) -> "Targets":
        """Quantities that a dataset has labels for.

        A state needs a frame of its own and one of another state; the angle two different angles
        of the untouched sensor; a position or force one frame that has it.
        """
        states = tuple(STATE_NAMES[state] for state in State if np.any(dataset.state == state))
        angles = untouched_angles(dataset)
        angles = angles[np.isfinite(angles)]
        placed = np.isfinite(dataset.touch_x)
        return cls(
            states if len(states) > 1 else (),
            len(angles) > 1 and float(np.ptp(angles)) > FLAT_DEG,
            bool(placed.any()),
            bool((placed & np.isfinite(dataset.touch_force)).any()),
        )

    @property
    def positions_only(self) -> bool:
        """Whether positions of touches are the only target, apart from forces."""
        return self.touches and not (self.states or self.angle)

    @property
    def missing(self) -> tuple[str, ...]:
        """Quantities that are no target, in words."""
        absent = [name for name in STATE_NAMES if name not in self.states]
        missing_labels = {
            "the state": not self.states,
            f"the state {' or '.join(absent)}": bool(self.states and absent),
            "the bend angle": not self.angle,
            "positions of touches": not self.touches,
            "forces": self.touches and not self.force,
        }
        return tuple(words for words, missing in missing_labels.items() if missing)

    def intersection(self, other: "Targets") -> "Targets":
        """Targets that both have."""
        states = tuple(state for state in self.states if state in other.states)
        return Targets(
            states if len(states) > 1 else (),
            self.angle and other.angle,
            self.touches and other.touches,
            self.force and other.force,
        )

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {**dataclasses.asdict(self), "states": list(self.states)}


def untouched_angles(dataset: Dataset) -> NDArray[np.float64]:
    """Bend angle of the untouched frames (n,) [deg]: 0 in idle frames, NaN in all others."""
    bent = np.where(dataset.state == State.BEND, dataset.bend_angle_deg.astype(float), np.nan)
    angles: NDArray[np.float64] = np.where(dataset.state == State.IDLE, 0.0, bent)
    return angles


def most_probable(probabilities: NDArray[np.float64]) -> NDArray[np.int64]:
    """Most probable `State` of each frame (n,) from probabilities (n, 3), NaN where not estimated.

    `UNKNOWN_STATE` where no state has a probability.
    """
    finite = np.isfinite(probabilities)
    best = np.where(finite, probabilities, -1.0).argmax(axis=1)
    state: NDArray[np.int64] = np.where(finite.any(axis=1), best, UNKNOWN_STATE)
    return state


def with_implied_labels(dataset: Dataset) -> Dataset:
    """The dataset with states and angles that follow from its other labels.

    - A frame of unknown state with a touch is touched. Where no frame of the dataset has a touch,
      one of unknown state and known angle is idle or bent.
    - Where no frame is bent, unknown angles are 0 deg.
    """
    state, angle = dataset.state.copy(), dataset.bend_angle_deg.copy()
    unknown, placed = state == UNKNOWN_STATE, dataset.touch_count > 0
    bent = np.abs(angle) > FLAT_DEG
    state[unknown & placed] = State.TOUCH
    if not np.any(state == State.TOUCH):
        implied = unknown & np.isfinite(angle)
        state[implied & bent], state[implied & ~bent] = State.BEND, State.IDLE
    if not (bent.any() or np.any(state == State.BEND)):
        angle[:] = 0.0
    return dataclasses.replace(dataset, state=state, bend_angle_deg=angle)


def require_targets(dataset: Dataset) -> Targets:
    """Quantities that a dataset has labels for; raises DataError where there are none."""
    targets = Targets.from_dataset(dataset)
    if not (targets.states or targets.angle or targets.touches):
        counts = ", ".join(
            f"{int(np.sum(dataset.state == state))} {state.name.lower()}" for state in State
        )
        raise DataError(
            "expected frames of two states, at several angles, or with positions of touches, to "
            f"learn from, got {counts} frames of {len(dataset)} and no positions; label them, or "
            "record frames of another state"
        )
    return targets


@old_names(of="from_dataset")
@dataclass(frozen=True, slots=True, eq=False)
class TrainingFrames:
    """Labelled frames that a method is fitted to.

    Attributes:
        observations: observations of the n frames: input, as `Method.predict` gets it.
        dataset: the same n frames with their labels; unknown ones are `UNKNOWN_STATE` or NaN.
        spec: sensor, measurements and units.
        noise: rms relative difference of two frames of a still sensor, dimensionless.
        validation: other frames, to watch losses on, not to fit to; None without.

    Example:
        >>> from eitskin.training import TrainingFrames
        >>> [name for name in TrainingFrames.__dataclass_fields__][:3]
        ['observations', 'dataset', 'spec']
    """

    observations: Observations
    dataset: Dataset
    spec: InputSpec
    noise: float
    validation: Dataset | None = None

    @classmethod
    def from_dataset(
        cls, dataset: Dataset, spec: InputSpec, validation: Dataset | None = None
    ) -> "TrainingFrames":
        """All frames of a dataset; raises DataError without labels or without idle frames."""
        require_targets(dataset)
        observations = Observations.from_dataset(dataset)
        return cls(observations, dataset, spec, frame_noise(dataset, observations), validation)

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.dataset)

    @property
    def targets(self) -> Targets:
        """Quantities that the frames have labels for."""
        return Targets.from_dataset(self.dataset)


def learnable(dataset: Dataset) -> tuple[Dataset, SensorDesign, Protocol]:
    """The dataset with labels that follow from others, its sensor and its table of measurements.

    A touch without a radius has the median of the others, or else `NOMINAL_RADIUS`.

    Raises DataError for a dataset without design, protocol or labels, or with positions of touches
    alone.
    """
    if dataset.design is None or dataset.protocol is None:
        raise DataError(
            "expected a dataset that names its sensor's design and table of measurements, got "
            "one without; learn touch positions from it, or save it with a design"
        )
    radius = dataset.touch_radius
    finite_radii = radius[np.isfinite(radius)]
    usual = float(np.median(finite_radii)) if finite_radii.size else NOMINAL_RADIUS
    lacking = np.isfinite(dataset.touch_x) & ~np.isfinite(radius)
    complete = dataclasses.replace(
        with_implied_labels(dataset), touch_radius=np.where(lacking, usual, radius)
    )
    if require_targets(complete).positions_only:
        raise DataError(
            "expected untouched frames besides the touched ones, got positions of touches alone;"
            " learn these with TrainingSettings('touch position'), as eitskin train does"
        )
    return complete, dataset.design, dataset.protocol
