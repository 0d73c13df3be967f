"""Graded cell sizes, and grid lines that follow them."""

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError

Lines = NDArray[np.float64]

_MIN_LINE_DISTANCE = 1e-9  # of two lines [m]
_MAX_POINTS = 1_000_000


@dataclass(frozen=True, slots=True)
class Grading:
    """Cell sizes of a mesh: size = min(coarsest, finest + growth * distance to the nearest edge).

    Potentials are singular at the edges of electrodes and smooth elsewhere.

    Attributes:
        finest: cell size at the electrode edges [m].
        coarsest: cell size far from them [m].
        growth: increase of cell size per distance from the nearest edge.
        layers: cells through each conductive sheet, where no electrode edge asks for more.
        level: cell height at level electrode edges [m]; `finest` when omitted.
    """

    finest: float
    coarsest: float
    growth: float
    layers: int = 1
    level: float | None = None

    def __post_init__(self) -> None:
        sizes = (self.finest, self.coarsest, self.growth, self.level or self.finest)
        if not all(math.isfinite(s) and s > 0 for s in sizes) or self.finest > self.coarsest:
            raise ConfigurationError(
                "grading needs 0 < finest <= coarsest in m and a positive growth, got "
                f"finest={self.finest}, coarsest={self.coarsest}, growth={self.growth}"
            )
        if self.layers < 1:
            raise ConfigurationError(f"grading needs at least one layer, got {self.layers}")

    def size(self, distance: Lines) -> Lines:
        """Cell size [m] at a distance from the nearest electrode edge [m]."""
        sizes: Lines = np.minimum(self.coarsest, self.finest + self.growth * distance)
        return sizes


def require_possible(points: float, grading: Grading) -> None:
    """Raise ConfigurationError for a number of points whose matrix would fill the memory.

    A linear hexahedron has 64 entries in the matrix, each of two integers and a value.
    """
    if points > _MAX_POINTS:
        raise ConfigurationError(
            f"a grid of {points:.2g} points, with cells of {grading.finest:g} to "
            f"{grading.coarsest:g} m, needs {points * 64 * 24 / 1e9:.2g} GB of memory or more; at "
            f"most {_MAX_POINTS:g} points are possible, choose a larger finest or coarsest size, "
            "more growth or fewer layers"
        )


def graded_lines(
    extent: float, edges: Iterable[float], breaks: Iterable[float], grading: Grading
) -> Lines:
    """Grid lines from 0 to `extent`, through all edges and breaks, graded to the edges [m].

    Raises ConfigurationError where two of these are nearly the same, which no mesh can resolve.
    """
    near = np.array(sorted(edges))
    fixed = np.unique(np.clip([0.0, extent, *near, *breaks], 0.0, extent).round(12))
    if np.diff(fixed).min() < _MIN_LINE_DISTANCE:
        raise ConfigurationError(
            f"lines of a mesh must be {_MIN_LINE_DISTANCE:g} m apart, got "
            f"{np.diff(fixed).min():g} m between "
            "edges of electrodes, ends of the sensor and breaks; move one of them"
        )
    attractors = near if len(near) else np.array([-np.inf])
    pieces = [fixed[:1]]
    for start, end in itertools.pairwise(fixed):
        # Samples that resolve the size: even ones, and geometric ones from both ends.
        steps = np.geomspace(min(1e-2 * grading.finest, end - start), end - start, 400)
        even = np.linspace(start, end, 401)
        fine = np.unique(np.clip(np.concatenate([even, start + steps, end - steps]), start, end))
        middle = 0.5 * (fine[:-1] + fine[1:])
        size = grading.size(np.abs(middle[:, None] - attractors).min(axis=1))
        # Grid lines are at equal steps of the cumulative number of cells.
        count = np.concatenate([[0.0], np.cumsum(np.diff(fine) / size)])
        require_possible(count[-1], grading)
        cells = max(1, int(np.ceil(count[-1] - 1e-9)))
        lines = np.interp(np.linspace(0.0, count[-1], cells + 1), count, fine)
        lines[-1] = end
        pieces.append(lines[1:])
    return np.concatenate(pieces)
