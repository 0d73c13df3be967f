"""Training frames of the joint method: touched, bent, and their mirror images."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import CLAMP_FIELDS, State
from eitskin.training.joint.combinations import Combinations, SpecimenFeatures
from eitskin.training.method.input_spec import Mirror

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

SCALE = 50.0  # deg, the unit of the angle in polynomials
POWERS = 3  # of the angle, by which the curves of specimens are compared
RIDGE = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class MirroredFrames:
    """Changes of log V in n frames of one kind, mirror images included.

    Attributes:
        change: since the reference, in K `combinations` (n, K).
        angle_deg: angle of the bend (n,) [deg].
        touches: x [m], y [m] and force [N] of up to k touches, NaN where absent (n, k, 3).
        specimen: number of the specimen, from 0 on (n,); mirror images share it.
        image: number of the symmetry (n,).
        flat: magnitudes of the frame's specimen, flat and untouched (n, C) [ohm].
        features: features of the specimen (n, P); none before `combine`.
        clamp: span [m], offset [m], number of held faces and ratio of the moduli of each frame's
            clamp, NaN where unknown, and whether its plates carry the sensor (n, 5).
        combinations: combinations of the measurements; each on its own before `combine`.
        variance: variance of the change, in units of that of one frame.
        noise: covariance of one frame's change (K, K); none before `combine`.
    """

    change: Array
    angle_deg: Array
    touches: Array
    specimen: Integers
    image: Integers
    flat: Array
    features: Array
    clamp: Array
    combinations: Combinations
    variance: float
    noise: Array

    @classmethod
    def from_touched(cls, data: Dataset, images: Sequence[Mirror]) -> "MirroredFrames":
        """Touched frames against the untouched sensor at the same bend."""
        rows = np.flatnonzero(is_touched(data))
        change = log_ratio(data.impedance[rows], data.touch_reference[rows])
        variance = 1.0 / data.touch_frames + 1.0 / data.reference_frames
        return cls._from_rows(data, rows, change, variance, images)

    @classmethod
    def from_bent(cls, data: Dataset, images: Sequence[Mirror]) -> "MirroredFrames":
        """Bent frames and the references of touches on the bent sensor, against the flat one."""
        bent = data.bend_angle_deg != 0
        untouched, referenced = bent & (data.state != State.TOUCH), bent & is_touched(data)
        rows = np.concatenate([np.flatnonzero(untouched), np.flatnonzero(referenced)])
        values = np.concatenate([data.impedance[untouched], data.touch_reference[referenced]])
        change = log_ratio(values, data.reference[data.specimen[rows]])
        variance = 1.0 if data.source == "simulated" else 2.0  # simulated references: noise-free
        return cls._from_rows(data, rows, change, variance, images)

    @classmethod
    def _from_rows(
        cls,
        data: Dataset,
        rows: NDArray[np.intp],
        change: Array,
        variance: float,
        images: Sequence[Mirror],
    ) -> "MirroredFrames":
        """Frames `rows` of a dataset and their mirror images, by the changes (rows, C)."""
        _, specimen = np.unique(data.specimen[rows], return_inverse=True)
        flat = np.abs(data.reference[data.specimen[rows]]).astype(float)
        x, y, force = (
            values[rows].astype(float) for values in (data.touch_x, data.touch_y, data.touch_force)
        )
        clamps = [getattr(data, name)[rows] for name in CLAMP_FIELDS]
        clamps.append(data.support_gap[rows] > 0.0)
        alone = Combinations(frame_noise(data, images))
        touches = [np.stack([*mirror.places(x, y), force], axis=-1) for mirror in images]
        return cls(
            np.concatenate([change[:, mirror.order] for mirror in images]),
            np.tile(data.bend_angle_deg[rows].astype(float), len(images)),
            np.concatenate(touches),
            np.tile(specimen.astype(np.int64), len(images)),
            np.repeat(np.arange(len(images)), len(rows)),
            np.concatenate([flat[:, mirror.order] for mirror in images]),
            np.zeros((len(rows) * len(images), 0)),
            np.tile(np.stack(clamps, axis=1).astype(float), (len(images), 1)),
            alone,
            variance,
            np.zeros((0, 0)),
        )

    def combine(
        self, features: SpecimenFeatures, combinations: Combinations, drift: float = 0.0
    ) -> "MirroredFrames":
        """The frames in combinations of their measurements, and with features of the specimens.

        Args:
            features: features of specimens.
            combinations: combinations of the measurements, which each are on their own so far.
            drift: variance of the change common to all measurements.
        """
        noise = np.diag(self.variance * combinations.unit**2)
        noise += np.outer(combinations.drift, combinations.drift) * drift
        return replace(
            self,
            change=self.change @ combinations.forward,
            features=features.apply(self.flat),
            combinations=combinations,
            noise=noise,
        )

    def __getitem__(self, rows: "slice | NDArray[np.generic]") -> "MirroredFrames":
        """Some of the frames."""
        names = ["change", "angle_deg", "touches", "specimen", "image", "flat", "features", "clamp"]
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    @property
    def specimens(self) -> int:
        """Number S of the specimens, which are numbered from 0 on."""
        return int(self.specimen.max()) + 1

    @property
    def curve(self) -> Integers:
        """Number of each frame's curve (n,): that of a specimen or of one of its mirror images."""
        return self.specimen + self.image * self.specimens

    def coordinates(self) -> Array:
        """Coordinates of the specimens by their bend curves (S, 2 `POWERS`).

        Specimens of one clamp bend alike and lie close together. The curves are least-squares
        polynomials; the coordinates are their first principal components.
        """
        powers = (self.angle_deg[:, None] / SCALE) ** np.arange(1, POWERS + 1)
        curves = np.zeros((self.specimens, POWERS * self.change.shape[1]))
        for number in range(self.specimens):
            rows = self.specimen == number
            gram = powers[rows].T @ powers[rows] + RIDGE * np.eye(POWERS)
            curves[number] = np.linalg.solve(gram, powers[rows].T @ self.change[rows]).ravel()
        left_vectors, sizes, _ = np.linalg.svd(curves - curves.mean(axis=0), full_matrices=False)
        coordinates: Array = (left_vectors * sizes)[:, : 2 * POWERS]
        return coordinates


def is_touched(data: Dataset) -> NDArray[np.bool_]:
    """Whether each frame (n,) has touches of known force and radius and a reference."""
    count = data.touch_count
    labels = [np.isfinite(v).sum(axis=1) == count for v in (data.touch_force, data.touch_radius)]
    touched: NDArray[np.bool_] = (count > 0) & labels[0] & labels[1] & data.has_touch_reference
    return touched


def is_untouched(data: Dataset) -> NDArray[np.bool_]:
    """Whether each frame (n,) is untouched and has a reference at the same bend."""
    untouched: NDArray[np.bool_] = (data.state != State.TOUCH) & data.has_touch_reference
    return untouched


def frame_noise(data: Dataset, images: Sequence[Mirror]) -> Array:
    """Standard deviation of log V in one frame (C,), averaged over mirror images."""
    quiet = is_untouched(data)
    change = log_ratio(data.impedance[quiet], data.touch_reference[quiet])
    variance = np.mean(change**2, axis=0) / (1.0 + 1.0 / data.reference_frames)
    floor = 1e-12  # noise-free training sets
    noise: Array = np.sqrt(np.mean([variance[m.order] for m in images], axis=0) + floor)
    return noise


def log_ratio(values: NDArray[np.generic], reference: NDArray[np.generic]) -> Array:
    """log |V / ref|."""
    change: Array = np.log(np.abs(values) / np.abs(reference)).astype(float)
    return change
