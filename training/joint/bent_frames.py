"""Bent frames of many specimens, and how alike these bend."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from eitskin.training.joint.combinations import Combinations

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

SCALE = 50.0  # deg, the unit of the angle in polynomials
POWERS = 3  # of the angle, by which the curves of specimens are compared
RIDGE = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class BentFrames:
    """n bent frames, mirror images included.

    Attributes:
        change: combinations of the change from the flat sensor (n, K).
        angle_deg: of the bend (n,) [deg].
        features: of the specimens (n, P).
        specimen: number of the specimen (n,); mirror images share it.
        image: number of the symmetry (n,).
        combinations: of the measurements.
        noise: covariance of one frame's change (K, K).
        clamp: span [m], offset [m], number of held faces and ratio of the moduli of each frame's
            clamp (n, 4); NaN where unknown.
    """

    change: Array
    angle_deg: Array
    features: Array
    specimen: Integers
    image: Integers
    combinations: Combinations
    noise: Array
    clamp: Array

    def __getitem__(self, rows: "slice | NDArray[np.generic]") -> "BentFrames":
        """Some of the frames."""
        return replace(
            self,
            change=self.change[rows],
            angle_deg=self.angle_deg[rows],
            features=self.features[rows],
            specimen=self.specimen[rows],
            image=self.image[rows],
            clamp=self.clamp[rows],
        )

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
        left, sizes, _ = np.linalg.svd(curves - curves.mean(axis=0), full_matrices=False)
        coordinates: Array = (left * sizes)[:, : 2 * POWERS]
        return coordinates
