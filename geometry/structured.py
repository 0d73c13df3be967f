"""Structured hexahedra, graded to the electrode edges."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.mesh import Contacts, Mesh
from eitskin.geometry.sensor import SensorDesign

Lines = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Grading:
    """Cell sizes of a structured mesh.

    Attributes:
        finest: cell size at the electrode edges [m].
        coarsest: cell size far from them [m].
        growth: increase of cell size per distance from the nearest edge.
        layers: cells through the thickness.
    """

    finest: float
    coarsest: float
    growth: float
    layers: int


def structured_mesh(design: SensorDesign, grading: Grading, breaks: Sequence[float] = ()) -> Mesh:
    """Mesh a rectangular design by boxes whose faces fit the electrode edges.

    Points are numbered along z, then y, then x, so that matrices are block tridiagonal in x.

    Args:
        design: the sensor.
        grading: cell sizes.
        breaks: further x at which the mesh must have a face, as where a deformation jumps [m].
    """
    x_lines, y_lines = _plane_lines(design, grading, breaks)
    z_lines = np.linspace(0.0, design.thickness, grading.layers + 1)
    shape = (len(x_lines), len(y_lines), len(z_lines))
    points = np.stack(np.meshgrid(x_lines, y_lines, z_lines, indexing="ij"), axis=-1)
    number = np.arange(np.prod(shape)).reshape(shape)
    lower, upper = number[:, :, :-1], number[:, :, 1:]
    cells = np.stack(
        [
            corner
            for plane in (lower, upper)
            for corner in (plane[:-1, :-1], plane[1:, :-1], plane[1:, 1:], plane[:-1, 1:])
        ],
        axis=-1,
    )
    sides = (number[:, 0], number[-1], number[:, -1], number[0])
    facets = []
    for index, electrode in enumerate(design.electrodes):
        side = design.side(index)
        along, centre = (x_lines, electrode.x) if side % 2 == 0 else (y_lines, electrode.y)
        middle = 0.5 * (along[:-1] + along[1:])
        covered = np.flatnonzero(np.abs(middle - centre) < electrode.width / 2)
        face = sides[side]
        quads = np.stack([face[:-1, :-1], face[1:, :-1], face[1:, 1:], face[:-1, 1:]], axis=-1)
        facets.append(quads[covered].reshape(-1, 4))
    points, cells = points.reshape(-1, 3), cells.reshape(-1, 8)
    return Mesh(points, cells, _contacts(points, cells, facets), z_lines)


def _contacts(
    points: NDArray[np.float64], cells: NDArray[np.int64], facets: list[NDArray[np.int64]]
) -> Contacts:
    """Whole facets, each with the cell that it bounds."""
    every = np.concatenate(facets)
    owners = [np.flatnonzero(np.isin(cells, facet).sum(axis=1) == 4)[0] for facet in every]
    numbers = np.repeat(np.arange(len(facets)), [len(f) for f in facets])
    return Contacts(numbers, np.array(owners), points[every], tuple(facets))


def _plane_lines(
    design: SensorDesign, grading: Grading, breaks: Sequence[float]
) -> tuple[Lines, Lines]:
    """Grid lines along x and y: on electrode edges and breaks, fine near the edges."""
    length, width = design.outline.length, design.outline.width
    edges: tuple[set[float], set[float]] = (set(), set())
    for index, electrode in enumerate(design.electrodes):
        side = design.side(index)
        centre = electrode.x if side % 2 == 0 else electrode.y
        edges[side % 2].update((centre - electrode.width / 2, centre + electrode.width / 2))
        edges[1 - side % 2].add((0.0, length, width, 0.0)[side])
    return (
        _graded(length, sorted(edges[0]), breaks, grading),
        _graded(width, sorted(edges[1]), (), grading),
    )


def _graded(
    extent: float, edges: Sequence[float], breaks: Sequence[float], grading: Grading
) -> Lines:
    """Lines from 0 to `extent` with cell size min(coarsest, finest + growth * distance)."""
    fixed = np.unique(np.clip([0.0, extent, *edges, *breaks], 0.0, extent).round(12))
    attractors = np.array(edges) if edges else np.array([-np.inf])
    pieces = [fixed[:1]]
    for start, end in itertools.pairwise(fixed):
        fine = np.linspace(start, end, 513)
        middle = 0.5 * (fine[:-1] + fine[1:])
        distance = np.abs(middle[:, None] - attractors).min(axis=1)
        size = np.minimum(grading.coarsest, grading.finest + grading.growth * distance)
        # Cumulative number of cells; lines go where it crosses equal steps.
        count = np.concatenate([[0.0], np.cumsum(np.diff(fine) / size)])
        cells = max(1, int(np.ceil(count[-1] - 1e-9)))
        lines = np.interp(np.linspace(0.0, count[-1], cells + 1), count, fine)
        lines[-1] = end
        pieces.append(lines[1:])
    return np.concatenate(pieces)
