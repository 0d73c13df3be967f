"""Energy products of potentials over pixels, for adjoint Jacobians on a regular grid."""

from collections.abc import Callable, Iterator
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
from eitskin.simulator.electrical.function_space import FunctionSpace

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
    grid, space, k = _Pixels(x_edges, y_edges), assembly.space, potentials.shape[-1]
    unseen = None
    if mesh.cells.shape[1] == 8:
        parts, unseen = _cut_boxes(space, mesh, grid), _missing_energy(assembly, potentials, along)
    elif mesh.cells.shape[1] == 6:
        parts = _cut_prisms(space, grid, k)
    else:
        every = np.arange(len(space.origins))
        parts = iter([_Part(every, assembly.points[..., :2], assembly.cell_weights)])
    total = np.zeros((rows * columns, k, k), dtype=potentials.dtype)
    for part in parts:
        products = _energy_products(assembly, potentials, part, along)
        if unseen is not None:
            area = part.weights.sum(axis=1) / space.jacobians[part.elements]
            products -= (area[:, None, None] * unseen[part.elements])[:, None]
        places = part.plane.mean(axis=1) if part.one_pixel else part.plane.reshape(-1, 2)
        np.add(total, grid.sums(places, products.reshape(-1, k, k), part.sizes), out=total)
    return total


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """Quadrature on some elements.

    Attributes:
        elements: numbers of the elements, (n,).
        plane: x and y of the points in each, (n, p, 2) [m].
        weights: weights of the points, (n, p): areas in columns [m2], volumes elsewhere [m3].
        upright: heights [m] and weights [m] of a rule over every point in columns, (q,) each.
        sizes: sides of the squares that the points stand for, (n p,) [m].
        one_pixel: whether all points of an element lie in one pixel.
    """

    elements: Indices
    plane: Array
    weights: Array
    upright: tuple[Array, Array] | None = None
    sizes: Array | float = 0.0
    one_pixel: bool = False


def _energy_products(
    assembly: Assembly, potentials: Numbers, part: _Part, along: Tensors | None
) -> Numbers:
    """Products grad u_k . S grad u_l by weights, of each point, (n, p, k, k), or of each element.

    Those of an element that lies in one pixel are summed, (n, 1, k, k).
    """
    count, points, k = *part.plane.shape[:2], potentials.shape[-1]
    weights = part.weights[..., None]
    if part.upright is None:
        places = assembly.points[:, :, None]
        gradients = assembly.cell_gradients(potentials).swapaxes(1, 2)[:, :, :, None]
    else:
        heights, along_height = part.upright
        weights = weights * along_height
        gradients = assembly.space.column_gradients(potentials, part.elements, part.plane, heights)
        places = np.empty((count, points, len(heights), 3))
        places[..., :2], places[..., 2] = part.plane[:, :, None], heights
    fluxes = gradients
    if along is not None:
        fluxes = np.moveaxis(along(places) @ np.moveaxis(gradients, 1, 3), 3, 1)
    pair: tuple[Numbers, Numbers] = gradients, weights[:, None, ..., None] * fluxes
    if part.one_pixel:
        first, second = (each.reshape(count, 1, -1, k) for each in pair)
    else:
        first, second = (np.moveaxis(each, 1, 2).reshape(count, points, -1, k) for each in pair)
    return first.swapaxes(2, 3) @ second


@dataclass(frozen=True, slots=True, eq=False)
class _Pixels:
    """Grid of pixels by their rising edges along x and y [m]."""

    x_edges: Array
    y_edges: Array

    def sums(self, points: Array, values: Numbers, sizes: Array | float = 0.0) -> Numbers:
        """Sums of values (n, k, k) at points (n, 2) [m] over each pixel, (pixels, k, k).

        A point stands for a square of side `sizes` (n,) [m], at most a pixel's, about it; pixels
        share the value by the areas of the square that lie in them.
        """
        rows, columns = len(self.y_edges) - 1, len(self.x_edges) - 1
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


def _cut_prisms(space: FunctionSpace, pixels: _Pixels, k: int) -> Iterator[_Part]:
    """Prisms: the elements' rule upwards, a rule of sub-triangles in the plane."""
    side = min(np.diff(pixels.x_edges)[0], np.diff(pixels.y_edges)[0])
    corners, upright = space.plane_corners(), space.upright_rule()
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    parts = np.where(longest > side, np.ceil(2.0 * longest / side), 1).astype(int)
    for n in np.unique(parts):
        shares, weights = _composite_rule(int(n), space.plane_degree)
        chosen = np.flatnonzero(parts == n)
        step = max(1, _AT_ONCE // (len(weights) * (3 * len(upright[0]) + k) * k))
        for start in range(0, len(chosen), step):
            elements = chosen[start : start + step]
            area = space.jacobians[elements, None] * weights
            sizes = np.sqrt(area).ravel() * (n > 1)
            yield _Part(elements, shares @ corners[elements], area, upright, sizes)


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


def _cut_boxes(space: FunctionSpace, mesh: Mesh, pixels: _Pixels) -> Iterator[_Part]:
    """Overlaps of boxes and pixels, with a Gauss rule that is exact for the elements."""
    x, y, z = (np.unique(mesh.points[:, axis]) for axis in range(3))
    order = space.element.face_degree + 1
    x_nodes, x_weights, x_cell = _overlaps(x, pixels.x_edges, order)
    y_nodes, y_weights, y_cell = _overlaps(y, pixels.y_edges, order)
    heights, upright, _ = _overlaps(z, z[[0, -1]], order)
    # A few overlaps along x at a time bound the memory.
    for start in range(0, len(x_nodes), _OVERLAPS):
        part = slice(start, start + _OVERLAPS)
        # Boxes of a structured mesh are numbered upwards first, then along y.
        elements = (x_cell[part, None] * (len(y) - 1) + y_cell).ravel()
        plane = _pairs(x_nodes[part], y_nodes)
        area = _pairs(x_weights[part], y_weights).prod(axis=-1)
        yield _Part(elements, plane, area, (heights.ravel(), upright.ravel()), one_pixel=True)


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


def _overlaps(faces: Array, pixel_edges: Array, order: int) -> tuple[Array, Array, Indices]:
    """Gauss points and weights (n, order) on n overlaps of cells and pixels, and their cells."""
    edges = np.unique(np.concatenate([faces, pixel_edges]).round(12))
    start, size = edges[:-1, None], np.diff(edges)[:, None]
    nodes, weights = np.polynomial.legendre.leggauss(order)
    cell = np.searchsorted(faces, (start + 0.5 * size)[:, 0]) - 1
    return start + 0.5 * (nodes + 1.0) * size, 0.5 * weights * size, cell
