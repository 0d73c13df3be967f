"""Prior covariance of a channel's map over the sheet: how alike touches at two places are."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_triangular

from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol
from eitskin.training.reconstruction.linear_model import linear_model
from eitskin.training.reconstruction.pixel_grid import PixelGrid

Array = NDArray[np.float64]

MOST_PLACES = 400  # of a kernel's features; smooth maps over a sheet need no more
DROPPED = 1e-6  # share of the prior variance that features may leave out
SPAN_PIXELS = 3600


@dataclass(frozen=True, slots=True, eq=False)
class DesignSpan:
    """Span of the sensitivity maps that a design allows, whatever the instrument does.

    To first order the response of every channel to a small change of conductivity at p is
    sum_jk w_jk grad u_j . grad u_k (p), where u_j is the potential for a current into electrode j
    (Geselowitz 1971): a linear network of loads and leaks at the electrodes changes the weights w
    alone. Independent weights of equal variance give the covariance
    sum_jk (grad u_j . grad u_k)(p) (grad u_j . grad u_k)(p').

    Attributes:
        maps: of pairs of electrodes, (pairs, rows, columns), rows along y; rms one over the sheet.
        size: of the bounding box, along x and y (2,) [m].
    """

    maps: Array
    size: Array

    @classmethod
    def of(cls, design: SensorDesign) -> "DesignSpan":
        """Solve the sensitivity maps of all pairs of electrodes, at coarse resolution."""
        grid = PixelGrid.of(design.outline, SPAN_PIXELS)
        n = len(design.electrodes)
        rows = [(j, 0, k, 0) for j in range(1, n) for k in range(j, n)]
        model = linear_model(design, Protocol.from_rows(rows, n), grid.shape, resolution="coarse")
        potentials = _centred(np.real(model.sensitivity).astype(float), n)
        inside = grid.outline.contains(_centres(grid))
        maps = potentials / np.sqrt(np.sum(potentials[:, inside] ** 2) / inside.sum())
        size = np.array([design.outline.length, design.outline.width])
        return cls(maps.reshape(-1, *grid.shape), size)

    def features(self, places: ArrayLike) -> Array:
        """Maps at places (n, 2) [m], linear between the pixels, (n, pairs)."""
        _, rows, columns = self.maps.shape
        flat = self.maps.reshape(len(self.maps), -1)
        at = np.asarray(places, dtype=float) / self.size * [columns, rows] - 0.5
        at = np.clip(at, 0.0, [columns - 1.0, rows - 1.0])
        corner = np.minimum(np.floor(at).astype(int), [columns - 2, rows - 2])
        (u, v), first = (at - corner).T, corner[:, 1] * columns + corner[:, 0]
        features: Array = (
            flat[:, first] * (1.0 - u) * (1.0 - v)
            + flat[:, first + 1] * u * (1.0 - v)
            + flat[:, first + columns] * (1.0 - u) * v
            + flat[:, first + columns + 1] * u * v
        ).T
        return features


@dataclass(frozen=True, slots=True, eq=False)
class PlaceKernel:
    """Matern 5/2 covariance of two places, mixed with the covariance of a design's span.

    Attributes:
        length: length scale [m].
        span: of the design; None for the plain kernel.
        share: of the span in the variance, 0 to 1.
    """

    length: float
    span: DesignSpan | None = None
    share: float = 0.0

    def __call__(self, first: ArrayLike, second: ArrayLike) -> Array:
        """Covariances (n, m) of places (n, 2) and (m, 2) [m]."""
        covariance: Array = self.of_features(self.described(first), self.described(second))
        return covariance

    def described(self, places: ArrayLike) -> tuple[Array, Array]:
        """Places (n, 2) [m], and the span's maps there (n, pairs); none without a share."""
        points = np.asarray(places, dtype=float)
        if self.span is None or self.share == 0.0:
            return points, np.zeros((len(points), 0))
        return points, self.span.features(points)

    def of_features(self, first: tuple[Array, Array], second: tuple[Array, Array]) -> Array:
        """Covariances (n, m) of places that `described` told of."""
        (a, span_a), (b, span_b) = first, second
        square = np.sum(a**2, axis=1)[:, None] + np.sum(b**2, axis=1) - 2.0 * a @ b.T
        d = np.sqrt(5.0 * np.maximum(square, 0.0)) / self.length
        covariance: Array = (1.0 - self.share) * (1.0 + d + d**2 / 3.0) * np.exp(-d)
        return covariance + self.share * span_a @ span_b.T

    def variance(self, places: ArrayLike) -> Array:
        """Variances (n,) at places (n, 2) [m]."""
        _, span = self.described(places)
        variance: Array = 1.0 - self.share + self.share * np.sum(span**2, axis=1)
        return variance


@dataclass(frozen=True, slots=True, eq=False)
class KernelFeatures:
    """Features phi with phi(p) . phi(p') = k(p, p'), exact at the chosen places.

    Attributes:
        kernel: the covariance.
        chosen: places that carry the features (m, 2) [m].
        factor: lower Cholesky factor of their covariance (m, m).
    """

    kernel: PlaceKernel
    chosen: Array
    factor: Array

    @classmethod
    def of(
        cls, kernel: PlaceKernel, places: ArrayLike, most: int = MOST_PLACES
    ) -> "KernelFeatures":
        """Choose places by a pivoted Cholesky factorisation (Harbrecht et al. 2012).

        Each step takes the place whose variance is explained worst, until `DROPPED` of the sum is
        left or `most` places are chosen: memory is bounded however many places there are.
        """
        points = np.asarray(places, dtype=float)
        left, described = kernel.variance(points), kernel.described(points)
        total, rows = float(left.sum()), np.zeros((min(most, len(points)), len(points)))
        chosen: list[int] = []
        for step in range(len(rows)):
            best = int(np.argmax(left))
            if left.sum() <= DROPPED * total or left[best] <= 1e-9 * total / len(points):
                break
            own = (described[0][best : best + 1], described[1][best : best + 1])
            row = kernel.of_features(own, described)[0] - rows[:step, best] @ rows[:step]
            rows[step] = row / np.sqrt(left[best])
            left = np.maximum(left - rows[step] ** 2, 0.0)
            left[best] = 0.0
            chosen.append(best)
        return cls(kernel, points[chosen], np.tril(rows[: len(chosen), chosen].T))

    def __call__(self, places: ArrayLike) -> Array:
        """Features (n, m) of places (n, 2) [m]."""
        covariance = self.kernel(self.chosen, places)
        features: Array = solve_triangular(self.factor, covariance, lower=True).T
        return features


def _centred(maps: Array, n: int) -> Array:
    """Maps of pairs (j, k), electrode 0 grounded, weighted so that all electrodes count alike.

    The patterns e_j - e_0 are replaced by e_j - mean(e), of which n - 1 are independent.
    """
    gram = np.zeros((n, n, maps.shape[1]))
    pairs = [(j, k) for j in range(1, n) for k in range(j, n)]
    for (j, k), values in zip(pairs, maps, strict=True):
        gram[j, k] = gram[k, j] = values
    centre = np.eye(n) - 1.0 / n
    gram = np.einsum("ab,cd,bdp->acp", centre, centre, gram, optimize=True)
    upper = [(j, k) for j in range(n) for k in range(j, n)]
    return np.array([gram[j, k] * (1.0 if j == k else np.sqrt(2.0)) for j, k in upper])


def _centres(grid: PixelGrid) -> Array:
    """Centres of all pixels of the bounding box, row by row (pixels, 2) [m]."""
    x, y = np.meshgrid(grid.x, grid.y)
    return np.stack([x.ravel(), y.ravel()], axis=1)
