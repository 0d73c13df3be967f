"""Energy products of potentials over pixels, for adjoint Jacobians on a regular grid."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import skfem
from numpy.typing import NDArray
from scipy.sparse import csr_array

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Outline
from eitskin.geometry.meshing.mesh import Mesh
from eitskin.geometry.meshing.mesh_body import MeshOutline
from eitskin.simulator.electrical.assembly import Assembly

Array = NDArray[np.float64]
Numbers = NDArray[np.inexact]
Indices = NDArray[np.int64]
Tensors = Callable[[Array], Array]

_OVERLAPS = 4  # along x, integrated at once
_AT_ONCE = 2**21  # numbers of prisms' gradients and products that are held at once


def pixel_gram(
    assembly: Assembly,
    mesh: Mesh,
    potentials: Numbers,
    outline: Outline | MeshOutline,
    pixels: tuple[int, int],
    along: Tensors | None = None,
) -> Numbers:
    """Integrals of grad u_k . S grad u_l over pixel columns, (rows * columns, k, k).

    Pixels divide the outline's bounding box, and a pixel column has the height of the body. On
    boxes, every overlap of a cell and a pixel is integrated on its own, exactly, and has its share
    of the energy that the cell's matrix leaves out; on other cells a pixel owns the quadrature
    points within it. Prisms larger than a pixel are divided for that into triangles of half a
    pixel's side, and neighbouring pixels share the surroundings of each point.

    Args:
        assembly: assembly of the mesh.
        mesh: mesh of the flat body.
        potentials: u_k element by element, (elements, functions, k).
        outline: outline of the sensor.
        pixels: number of rows along y and of columns along x.
        along: field S(x) of symmetric tensors, (..., 3) [m] to (..., 3, 3); identity when omitted.

    Raises ConfigurationError for numbers of pixels that are not positive.
    """
    rows, columns = pixels
    if rows < 1 or columns < 1:
        raise ConfigurationError(f"pixels must be two positive numbers, got {pixels}")
    x, y = outline.corner
    x_edges = np.linspace(x, x + outline.length, columns + 1)
    y_edges = np.linspace(y, y + outline.width, rows + 1)
    if mesh.cells.shape[1] == 8:
        return _boxes_gram(assembly, mesh, potentials, x_edges, y_edges, along)
    grid = _Pixels(x_edges, y_edges)
    if mesh.cells.shape[1] == 6:
        return _prisms_gram(assembly, potentials, grid, along)
    gradients = assembly.cell_gradients(potentials)
    fluxes = gradients if along is None else along(assembly.points) @ gradients
    fluxes = assembly.cell_weights[..., None, None] * fluxes
    products = (gradients.swapaxes(2, 3) @ fluxes).reshape(-1, *[potentials.shape[-1]] * 2)
    return grid.sums(assembly.points[..., :2].reshape(-1, 2), products)


@dataclass(frozen=True, slots=True, eq=False)
class _Pixels:
    """Grid of pixels by their rising edges along x and y [m]."""

    x_edges: Array
    y_edges: Array

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and of columns."""
        return len(self.y_edges) - 1, len(self.x_edges) - 1

    def sums(self, points: Array, values: Numbers, sizes: Array | float = 0.0) -> Numbers:
        """Sums of values (n, k, k) at points (n, 2) [m] over each pixel, (pixels, k, k).

        A point stands for a square of side `sizes` (n,) [m], at most a pixel's, about it; pixels
        share the value by the areas of the square that lie in them.
        """
        rows, columns = self.shape
        across = _shares(points[:, 0], self.x_edges, sizes)
        along = _shares(points[:, 1], self.y_edges, sizes)
        pixel = [row * columns + column for row, _ in along for column, _ in across]
        share = [up * right for _, up in along for _, right in across]
        count = len(points)
        owned = csr_array(
            (np.concatenate(share), (np.concatenate(pixel), np.tile(np.arange(count), 4))),
            shape=(rows * columns, count),
        )
        total: Numbers = owned @ values.reshape(count, -1)
        return total.reshape(-1, *values.shape[1:])


def _shares(x: Array, edges: Array, sizes: Array | float) -> list[tuple[Indices, Array]]:
    """Two neighbouring intervals and shares in these of segments of `sizes` about x, (n,) each."""
    last = len(edges) - 2
    low = np.clip(np.searchsorted(edges, x - 0.5 * sizes, side="right") - 1, 0, last)
    high = np.minimum(low + 1, last)
    beyond = (x + 0.5 * sizes - edges[low + 1]) / np.maximum(sizes, np.finfo(float).tiny)
    share = np.where(high > low, np.clip(beyond, 0.0, 1.0), 0.0)
    return [(low, 1.0 - share), (high, share)]


def _prisms_gram(
    assembly: Assembly, potentials: Numbers, pixels: _Pixels, along: Tensors | None
) -> Numbers:
    """Integrals on prisms: the elements' rule upwards, a rule of sub-triangles in the plane."""
    space, side = assembly.space, min(np.diff(pixels.x_edges)[0], np.diff(pixels.y_edges)[0])
    corners = space.plane_corners()
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    parts = np.where(longest > side, np.ceil(2.0 * longest / side), 1).astype(int)
    heights, upright = space.upright_rule()
    k = potentials.shape[-1]
    total = np.zeros((np.prod(pixels.shape), k, k), potentials.dtype)
    for n in np.unique(parts):
        shares, weights = _composite_rule(int(n), space.plane_degree)
        chosen = np.flatnonzero(parts == n)
        step = max(1, _AT_ONCE // (len(weights) * (3 * len(heights) + k) * k))
        for start in range(0, len(chosen), step):
            elements = chosen[start : start + step]
            plane = shares @ corners[elements]
            area = (space.jacobians[elements, None] * weights)[..., None] * upright
            fluxes = _gradients_and_fluxes(
                assembly, potentials, elements, plane, heights, area, along
            )
            first, second = (np.moveaxis(g, 1, 2).reshape(*plane.shape[:2], -1, k) for g in fluxes)
            products = first.swapaxes(2, 3) @ second
            sizes = np.sqrt(space.jacobians[elements, None] * weights).ravel() * (n > 1)
            sums = pixels.sums(plane.reshape(-1, 2), products.reshape(-1, k, k), sizes)
            np.add(total, sums, out=total)
    return total


def _composite_rule(n: int, degree: int) -> tuple[Array, Array]:
    """Barycentric points (q, 3) and weights (q,) of a rule on n^2 equal parts of a triangle.

    The whole triangle is integrated to `degree`; its parts, which are small, to the second.
    """
    (u, v), weights = skfem.quadrature.get_quadrature(skfem.refdom.RefTri, degree if n == 1 else 2)
    i, j = (index.ravel() for index in np.meshgrid(np.arange(n), np.arange(n)))
    upright, turned = i + j < n, i + j < n - 1
    x = [*(i[upright, None] + u), *(i[turned, None] + 1.0 - u)]
    y = [*(j[upright, None] + v), *(j[turned, None] + 1.0 - v)]
    u, v = np.ravel(x) / n, np.ravel(y) / n
    return np.stack([1.0 - u - v, u, v], axis=1), np.tile(weights, n * n) / n**2


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
    x_shares, y_shares = (
        weights.sum(axis=1, keepdims=True) / np.diff(faces)[cell][:, None]
        for weights, faces, cell in ((x_weights, x, x_cell), (y_weights, y, y_cell))
    )
    unseen = _missing_energy(assembly, potentials, along)
    count, columns = potentials.shape[-1], len(x_edges) - 1
    total = np.zeros((columns * (len(y_edges) - 1), count, count), dtype=potentials.dtype)
    # A few overlaps along x at a time bound the memory.
    for start in range(0, len(x_nodes), _OVERLAPS):
        part = slice(start, start + _OVERLAPS)
        plane = _pairs(x_nodes[part], y_nodes)
        # Boxes of a structured mesh are numbered upwards first, then along y.
        elements = (x_cell[part, None] * (len(y) - 1) + y_cell).ravel()
        area = _pairs(x_weights[part], y_weights).prod(axis=-1)[..., None] * z_weights
        both = _gradients_and_fluxes(assembly, potentials, elements, plane, z_nodes, area, along)
        gradients, fluxes = (each.reshape(len(plane), -1, count) for each in both)
        products = gradients.swapaxes(1, 2) @ fluxes
        shares = _pairs(x_shares[part], y_shares).prod(axis=-1)
        products -= shares[..., None] * unseen[elements]
        np.add.at(total, (y_pixel * columns + x_pixel[part, None]).ravel(), products)
    return total


def _gradients_and_fluxes(
    assembly: Assembly,
    potentials: Numbers,
    elements: Indices,
    plane: Array,
    heights: Array,
    weights: Array,
    along: Tensors | None,
) -> tuple[Numbers, Numbers]:
    """Gradients of u_k, and S times these by weights (n, p, q) [m3], both (n, 3, p, q, k).

    At heights (q,) [m] above points of the plane (n, p, 2) [m] in the columns `elements`.
    """
    gradients = assembly.space.column_gradients(potentials, elements, plane, heights)
    fluxes = gradients
    if along is not None:
        points = np.empty((*gradients.shape[:1], *gradients.shape[2:4], 3))
        points[..., :2], points[..., 2] = plane[:, :, None], heights
        fluxes = np.moveaxis(along(points) @ np.moveaxis(gradients, 1, 3), 3, 1)
    return gradients, weights[:, None, ..., None] * fluxes


def _missing_energy(assembly: Assembly, potentials: Numbers, along: Tensors | None) -> Numbers:
    """Energy products that the matrices of columns of cells leave out, (elements, k, k)."""
    tensors = None
    if along is not None:
        weights = assembly.cell_weights[..., None, None]
        tensors = (weights * along(assembly.points)).sum(axis=1) / weights.sum(axis=1)
    unseen = assembly.unseen_gram(potentials, tensors)
    by_cell = unseen.reshape(-1, assembly.space.element.cells, *unseen.shape[1:])
    return np.asarray(by_cell.sum(axis=1))


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
