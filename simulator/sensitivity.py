"""Energy products of potentials over pixels, for Jacobians on a regular grid."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry import ConfigurationError, Mesh
from eitskin.geometry.outline import Outline
from eitskin.simulator.assembly import Assembly

Array = NDArray[np.float64]
Numbers = NDArray[np.inexact]
Tensors = Callable[[Array], Array]

_LINES = 4  # of quadrature points along y that are integrated at once


def pixel_gram(
    assembly: Assembly,
    mesh: Mesh,
    potentials: Numbers,
    outline: Outline,
    pixels: tuple[int, int],
    along: Tensors | None = None,
) -> Numbers:
    """int over each pixel column of grad u_k . S grad u_l, (rows * columns, k, k).

    S is a field of symmetric tensors, `along` of places, or one everywhere where omitted.

    Pixels divide the outline's bounding box. On boxes, every overlap of a cell and a pixel is
    integrated by itself, exactly; on other cells a pixel owns the quadrature points within it,
    which is exact for a conductivity given by pixels as a function of place.
    """
    rows, columns = pixels
    if rows < 1 or columns < 1:
        raise ConfigurationError(f"pixels must be two positive numbers, got {pixels}")
    x_edges = np.linspace(0, outline.length, columns + 1)
    y_edges = np.linspace(0, outline.width, rows + 1)
    if mesh.cells.shape[1] == 8:
        return _boxes_gram(assembly, mesh, potentials, x_edges, y_edges, along)
    x, y = assembly.points[..., 0], assembly.points[..., 1]
    column = np.clip(np.searchsorted(x_edges, x, side="right") - 1, 0, columns - 1)
    row = np.clip(np.searchsorted(y_edges, y, side="right") - 1, 0, rows - 1)
    gradients = assembly.cell_gradients(potentials)
    fluxes = _fluxes(gradients, assembly.points, along)
    products = np.einsum(
        "cq,cqbk,cqbl->cqkl", assembly.cell_weights, gradients, fluxes, optimize=True
    )
    total = np.zeros((rows * columns, *products.shape[2:]), dtype=products.dtype)
    np.add.at(total, row * columns + column, products)
    return total


def _boxes_gram(
    assembly: Assembly,
    mesh: Mesh,
    potentials: Numbers,
    x_edges: Array,
    y_edges: Array,
    along: Tensors | None,
) -> Numbers:
    """The integrals on boxes, by a Gauss rule on every overlap that is exact for the elements."""
    x, y, z = (np.unique(mesh.points[:, axis]) for axis in range(3))
    order = assembly.space.element.face_degree + 1
    x_nodes, x_weights, x_cell, x_pixel = _overlaps(x, x_edges, order)
    y_nodes, y_weights, y_cell, y_pixel = _overlaps(y, y_edges, order)
    z_nodes, z_weights, z_cell, _ = _overlaps(z, z[[0, -1]], order)
    count, columns = potentials.shape[-1], len(x_edges) - 1
    total = np.zeros((columns * (len(y_edges) - 1), count, count), dtype=potentials.dtype)
    # A few lines of x at a time keep memory flat.
    for start in range(0, len(x_nodes), _LINES):
        part = slice(start, start + _LINES)
        grid = np.meshgrid(x_nodes[part], y_nodes, z_nodes, indexing="ij")
        points = np.stack(grid, axis=-1).reshape(-1, 3)
        cells = _cell_numbers(x_cell[part], y_cell, z_cell, (len(x), len(y), len(z)))
        elements = cells.ravel() // assembly.space.element.cells
        gradients = assembly.space.gradients(potentials, elements, points)
        weights = x_weights[part, None, None] * y_weights[:, None] * z_weights
        fluxes = weights.reshape(-1, 1, 1) * _fluxes(gradients, points, along)
        # Over directions and heights at once: what lies on one line upwards is in one pixel.
        lines = (len(points) // len(z_nodes), -1, count)
        products = gradients.reshape(lines).swapaxes(1, 2) @ fluxes.reshape(lines)
        pixels = y_pixel * columns + x_pixel[part, None]
        np.add.at(total, pixels.ravel(), products)
    return total


def _fluxes(gradients: Numbers, points: Array, along: Tensors | None) -> Numbers:
    """S grad u_k (..., 3, k) of gradients (..., 3, k) at points (..., 3)."""
    return gradients if along is None else along(points) @ gradients


def _cell_numbers(
    ix: NDArray[np.int64],
    iy: NDArray[np.int64],
    iz: NDArray[np.int64],
    shape: tuple[int, int, int],
) -> NDArray[np.int64]:
    """Numbers of the boxes (ix, iy, iz) of a structured mesh with `shape` lines, (ix, iy, iz)."""
    return (ix[:, None, None] * (shape[1] - 1) + iy[:, None]) * (shape[2] - 1) + iz


def _overlaps(
    faces: Array, pixel_edges: Array, order: int
) -> tuple[Array, Array, NDArray[np.int64], NDArray[np.int64]]:
    """Gauss points and weights on all overlaps of cells and pixels, and both their numbers."""
    edges = np.unique(np.concatenate([faces, pixel_edges]).round(12))
    start, size = edges[:-1], np.diff(edges)
    nodes, weights = np.polynomial.legendre.leggauss(order)
    points = (start[:, None] + 0.5 * (nodes + 1.0) * size[:, None]).ravel()
    middle = np.repeat(start + 0.5 * size, len(nodes))
    return (
        points,
        (0.5 * weights * size[:, None]).ravel(),
        np.searchsorted(faces, middle) - 1,
        np.searchsorted(pixel_edges, middle) - 1,
    )
