"""Energy products of potentials over pixels, for adjoint Jacobians on a regular grid."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Outline
from eitskin.geometry.meshing.mesh import Mesh
from eitskin.simulator.electrical.assembly import Assembly

Array = NDArray[np.float64]
Numbers = NDArray[np.inexact]
Tensors = Callable[[Array], Array]

_OVERLAPS = 4  # along x, integrated at once


def pixel_gram(
    assembly: Assembly,
    mesh: Mesh,
    potentials: Numbers,
    outline: Outline,
    pixels: tuple[int, int],
    along: Tensors | None = None,
) -> Numbers:
    """Integrals of grad u_k . S grad u_l over pixel columns, (rows * columns, k, k).

    Pixels divide the outline's bounding box, and a pixel column has the height of the body. On
    boxes, every overlap of a cell and a pixel is integrated by itself, exactly; on other cells a
    pixel owns the quadrature points within it, which is exact for a conductivity that is a function
    of position constant in each pixel.

    Args:
        assembly: of the mesh.
        mesh: of the flat body.
        potentials: u_k element by element, (elements, functions, k).
        outline: of the sensor.
        pixels: number of rows along y and of columns along x.
        along: field S(x) of symmetric tensors, (..., 3) [m] to (..., 3, 3); identity when omitted.

    Raises ConfigurationError for numbers of pixels that are not positive.
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
    fluxes = gradients if along is None else along(assembly.points) @ gradients
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
    """Integrals on boxes, by a Gauss rule on every overlap that is exact for the elements."""
    x, y, z = (np.unique(mesh.points[:, axis]) for axis in range(3))
    order = assembly.space.element.face_degree + 1
    x_nodes, x_weights, x_cell, x_pixel = _overlaps(x, x_edges, order)
    y_nodes, y_weights, y_cell, y_pixel = _overlaps(y, y_edges, order)
    z_nodes, z_weights = (part.ravel() for part in _overlaps(z, z[[0, -1]], order)[:2])
    count, columns = potentials.shape[-1], len(x_edges) - 1
    total = np.zeros((columns * (len(y_edges) - 1), count, count), dtype=potentials.dtype)
    # A few overlaps along x at a time bound the memory.
    for start in range(0, len(x_nodes), _OVERLAPS):
        part = slice(start, start + _OVERLAPS)
        plane = _pairs(x_nodes[part], y_nodes)
        # Boxes of a structured mesh are numbered upwards first, then along y.
        elements = (x_cell[part, None] * (len(y) - 1) + y_cell).ravel()
        gradients = assembly.space.column_gradients(potentials, elements, plane, z_nodes)
        fluxes = gradients
        if along is not None:
            points = np.empty((*gradients.shape[:1], *gradients.shape[2:4], 3))
            points[..., :2], points[..., 2] = plane[:, :, None], z_nodes
            fluxes = np.moveaxis(along(points) @ np.moveaxis(gradients, 1, 3), 3, 1)
        weights = _pairs(x_weights[part], y_weights).prod(axis=-1)[..., None] * z_weights
        fluxes = weights[:, None, ..., None] * fluxes
        flat = (len(plane), -1, count)
        products = gradients.reshape(flat).swapaxes(1, 2) @ fluxes.reshape(flat)
        np.add.at(total, (y_pixel * columns + x_pixel[part, None]).ravel(), products)
    return total


def _pairs(x: Array, y: Array) -> Array:
    """Pairs of x (a, o) and y (b, o) on overlaps, overlap by overlap, (a b, o o, 2)."""
    shape = (len(x), len(y), x.shape[1], y.shape[1])
    pairs = (np.broadcast_to(c, shape) for c in (x[:, None, :, None], y[:, None]))
    return np.stack(list(pairs), axis=-1).reshape(len(x) * len(y), -1, 2)


def _overlaps(
    faces: Array, pixel_edges: Array, order: int
) -> tuple[Array, Array, NDArray[np.int64], NDArray[np.int64]]:
    """Gauss points and weights (n, order) on n overlaps, and the cell and pixel of each overlap."""
    edges = np.unique(np.concatenate([faces, pixel_edges]).round(12))
    start, size = edges[:-1, None], np.diff(edges)[:, None]
    nodes, weights = np.polynomial.legendre.leggauss(order)
    middle = (start + 0.5 * size)[:, 0]
    return (
        start + 0.5 * (nodes + 1.0) * size,
        0.5 * weights * size,
        np.searchsorted(faces, middle) - 1,
        np.searchsorted(pixel_edges, middle) - 1,
    )
