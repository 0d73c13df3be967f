"""Known frames: labelled frames of one sensor, as a trained method is adapted to it by them."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol as Interface

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets import UNKNOWN_STATE, Dataset, State
from eitskin.geometry import ConfigurationError, DataError, Surface
from eitskin.simulator import Frame
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.method.observations import Observations

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FLAT_DEG = 0.05  # angle up to which a sensor counts as flat
MAX_BEND_DEG = 360.0  # of a bend; a roll turns no further than once
SIDE_MARGIN = 0.001  # m, by which a place may be reported next to the sensor


@dataclass(frozen=True, slots=True)
class TouchLabel:
    """Known position of a touch, and its force if that is known.

    Attributes:
        x, y: centre of the indenter, in coordinates of the flat sensor [m].
        force: normal force [N]; None where unknown.

    Example:
        >>> from eitskin.training import TouchLabel
        >>> TouchLabel(0.075, 0.030, force=8.0).force
        8.0
    """

    x: float
    y: float
    force: float | None = None

    def __post_init__(self) -> None:
        """Raise DataError for a place or force that cannot be."""
        if not (math.isfinite(self.x) and math.isfinite(self.y)):
            raise DataError(f"expected the position of a touch in metres, got ({self.x}, {self.y})")
        if self.force is not None and not (math.isfinite(self.force) and self.force > 0.0):
            raise DataError(
                f"expected the force of a touch above 0 N, or None where unknown, got {self.force}"
            )


@dataclass(frozen=True, slots=True)
class FrameLabel:
    """Known angle and touches of a frame; `FrameLabel()` is the flat, untouched sensor.

    Attributes:
        angle_deg: bend angle [deg]; None where unknown.
        touches: all touches, none of an untouched sensor; None where unknown.

    Example:
        >>> from eitskin.training import FrameLabel, TouchLabel
        >>> FrameLabel(angle_deg=0.0, touches=(TouchLabel(0.075, 0.030),)).angle_deg
        0.0
    """

    angle_deg: float | None = 0.0
    touches: tuple[TouchLabel, ...] | None = ()

    def __post_init__(self) -> None:
        """Raise DataError for an angle that no bend has."""
        if self.angle_deg is not None and not abs(self.angle_deg) <= MAX_BEND_DEG:
            raise DataError(
                f"expected an angle up to {MAX_BEND_DEG:g} deg, or None where unknown, got "
                f"{self.angle_deg:g}"
            )

    @property
    def flat(self) -> bool:
        """Whether the sensor is known to be flat and untouched."""
        return self.touches == () and self.angle_deg is not None and abs(self.angle_deg) <= FLAT_DEG


class TwinPresses(Interface):
    """Presses on the twin of a sensor; `PressedTwin` simulates them."""

    def changes(self, touches: Array, angle_deg: float, radius: float) -> Array:
        """Changes of log V (n, C) by single touches (n, 3) of x [m], y [m] and force [N].

        Args:
            touches: one in each row.
            angle_deg: angle of the bend, before and during the touches [deg].
            radius: radius of the indenter [m].
        """

    def inside(self, places: Array) -> Mask:
        """Whether positions (n, 2) [m] are on the sensor (n,)."""


def held_numbers(seen: Array) -> NDArray[np.intp]:
    """Number of the held touches that each frame shows (n,): the same while `seen` (n, k) stays.

    They are one touch to learn from: errors of a response and of the place are the same in all.
    """
    touch_values = np.nan_to_num(seen, nan=-1.0)
    moved = (touch_values[1:] != touch_values[:-1]).any(axis=1)
    return np.cumsum(np.concatenate([np.zeros(min(len(touch_values), 1), dtype=bool), moved]))


@dataclass(frozen=True, slots=True, eq=False)
class KnownFrames:
    """n labelled frames of one sensor with their references; up to k touches in one.

    Attributes:
        observations: changes from the flat sensor (`static`) and from an untouched frame before the
            touch (`dynamic`), in n frames; the flat magnitudes are the same in all rows.
        angle_deg: bend angle (n,) [deg]; NaN where unknown.
        reference_deg: bend angle of the dynamic reference (n,) [deg]; NaN where unknown.
        touches: x [m], y [m] and force [N] (n, k, 3); NaN where absent, a force where unknown.
        reported: whether the touches of each frame are known (n,); none are, where it has none.
        twin: twin of the sensor; None without one.
    """

    observations: Observations
    angle_deg: Array
    reference_deg: Array
    touches: Array
    told: Mask
    twin: TwinPresses | None = None

    @classmethod
    def from_frames(
        cls,
        frames: Sequence[Frame] | Dataset,
        labels: Sequence[FrameLabel] | None,
        spec: InputSpec,
    ) -> "KnownFrames":
        """Compare frames with the mean of the flat ones, and touched ones with untouched ones.

        The dynamic reference of a frame is the mean of the latest untouched frames in succession
        with its angle; of any one angle where that of the frame is unknown; of the next ones where
        none came before. Without any it is the flat sensor. A dataset has references of its own.

        Args:
            frames: frames of one session, in order; or a dataset of one specimen.
            labels: one for each frame; None for a dataset, which has its own.
            spec: spec of the pipeline.

        Raises:
            ConfigurationError: without a label for each frame, without a flat frame, or for a
                dataset of several specimens, without a protocol, or with labels next to its own.
            FrameError: for a frame of another sensor, table or frequency.
            DataError: for a touch next to the sensor.
        """
        if isinstance(frames, Dataset):
            if labels is not None:
                raise ConfigurationError(
                    "expected no labels besides those of the dataset, got some; label frames, or "
                    "the dataset"
                )
            return cls._from_dataset(frames, spec)
        labels = labels or ()
        if len(labels) != len(frames):
            raise ConfigurationError(
                f"expected one label for each frame, got {len(labels)} labels and "
                f"{len(frames)} frames"
            )
        angles = np.array([label.angle_deg for label in labels], dtype=float)  # None becomes NaN
        free = np.array([label.touches == () for label in labels], dtype=bool)
        flat = free & (np.abs(angles) <= FLAT_DEG)
        if not flat.any():
            raise ConfigurationError(
                "expected at least one frame of the flat, untouched sensor among the known frames, "
                f"got none of {len(frames)}; record the flat sensor first"
            )
        touches = _touches(labels, spec)
        logs = np.log(np.abs([spec.voltages(frame)[0] for frame in frames]))
        reference = _mean(logs[flat])
        spec.require_same_sensor(np.exp(reference).astype(np.complex128), adapting=True)
        time = np.array([frame.time for frame in frames])
        befores = [_reference_rows(angles, free, row) for row in range(len(labels))]
        before = np.array([_mean(logs[rows]) if rows else reference for rows in befores])
        count, since = int(flat.sum()), float(time[flat].min())
        renewed = np.array([time[rows].max() if rows else since for rows in befores])
        observations = Observations(
            static=np.expm1(logs - reference),
            dynamic=np.expm1(logs - before),
            flat=np.tile(np.exp(reference), (len(frames), 1)),
            frames=np.ones(len(frames)),
            static_frames=np.full(len(frames), float(count)),
            dynamic_frames=np.array([float(len(rows) or count) for rows in befores]),
            age=np.maximum(time - since, 0.0),
            dynamic_age=np.maximum(time - renewed, 0.0),
        )
        referred = [angles[rows[0]] if rows else 0.0 for rows in befores]
        has_touch_label = np.array([label.touches is not None for label in labels])
        return cls(observations, angles, np.array(referred), touches, has_touch_label)

    @classmethod
    def _from_dataset(cls, data: Dataset, spec: InputSpec) -> "KnownFrames":
        """All frames of a dataset of one specimen, with its labels; see `from_frames`."""
        specimens = np.unique(data.specimen)
        if len(specimens) != 1 or data.protocol is None:
            raise ConfigurationError(
                "expected frames of one specimen, with their protocol, to adapt to, got "
                f"{len(specimens)} specimens and the protocol {data.protocol}; select those of one"
            )
        spec.require_same_measurements(data.protocol, data.frequency)
        spec.require_same_sensor(data.reference[specimens[0]].astype(np.complex128), adapting=True)
        idle = data.state == State.IDLE
        angle = np.where(idle, 0.0, data.bend_angle_deg.astype(float))
        touches = np.stack([data.touch_x, data.touch_y, data.touch_force], axis=-1).astype(float)
        placed = data.touch_count > 0
        has_touch_label = placed | ((data.state != State.TOUCH) & (data.state != UNKNOWN_STATE))
        before = np.where(data.has_touch_reference, angle, 0.0)
        return cls(Observations.from_dataset(data), angle, before, touches, has_touch_label)

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.observations)

    def __getitem__(self, rows: slice | NDArray[np.generic]) -> "KnownFrames":
        """The frames of `rows` (slice, integers or mask)."""
        names = ("observations", "angle_deg", "reference_deg", "touches", "told")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    @property
    def has_touches(self) -> Mask:
        """Whether each frame (n,) has touches at known places."""
        return np.asarray(np.isfinite(self.touches[..., 0]).any(axis=1))

    @property
    def is_bent(self) -> Mask:
        """Whether each frame (n,) is untouched and bent by a known angle."""
        return np.asarray(self.told & ~self.has_touches & (np.abs(self.angle_deg) > FLAT_DEG))

    @property
    def flat(self) -> Mask:
        """Whether each frame (n,) is known to be flat and untouched."""
        return np.asarray(self.told & ~self.has_touches & (np.abs(self.angle_deg) <= FLAT_DEG))


def _mean(logs: Array) -> Array:
    """Mean (C,) of logarithms (n, C); NaN where a measurement is bad in all rows."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        mean: Array = np.nanmean(logs, axis=0)
    return mean


def _reference_rows(angles: Array, free: Mask, row: int) -> list[int]:
    """Numbers of the untouched frames that a frame is compared with; empty without any.

    Angles (n,) [deg] are NaN where unknown; `free` are the frames known to be untouched (n,).
    """
    fits = free & (np.isnan(angles[row]) | (np.abs(angles[row] - angles) <= FLAT_DEG))
    for rows in (range(row - 1, -1, -1), range(row + 1, len(angles))):
        found: list[int] = []  # the first in succession that fit, all of one angle
        for other in rows:
            with_first = not found or abs(angles[found[0]] - angles[other]) <= FLAT_DEG
            if fits[other] and with_first:
                found.append(other)
            elif found:
                break
        if found:
            return found
    return []


def _touches(labels: Sequence[FrameLabel], spec: InputSpec) -> Array:
    """Table (n, k, 3) of x [m], y [m] and force [N] of all touches, NaN where there is none.

    Raises DataError for a touch next to the sensor.
    """
    rows = [label.touches or () for label in labels]
    table = np.full((len(rows), max(1, *map(len, rows)), 3), np.nan)
    for row, touches in enumerate(rows):
        for k, touch in enumerate(touches):
            table[row, k] = touch.x, touch.y, math.nan if touch.force is None else touch.force
    if not isinstance(spec.design.outline, Surface):
        size = np.array(spec.outline)
        beside = (table[..., :2] < -SIDE_MARGIN) | (table[..., :2] > size + SIDE_MARGIN)
        for x, y, _ in table[beside.any(axis=2)]:
            raise DataError(
                f"expected touches on the sensor of {size[0]:g} x {size[1]:g} m, got one at "
                f"({x:g}, {y:g}) m; places are in metres from the corner"
            )
    return table
