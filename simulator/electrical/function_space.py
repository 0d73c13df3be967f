"""Finite element space on a mesh: numbers of unknowns, element maps, quadrature, memory."""

import math
from typing import NamedTuple

import numpy as np
import skfem
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.meshing.mesh import Mesh
from eitskin.simulator.electrical.elements import Element, ExtrudedElement, TetrahedralElement

Array = NDArray[np.float64]
Numbers = NDArray[np.inexact]
Indices = NDArray[np.int64]
MAX_MEMORY = 8e9  # [byte]
# Bytes per number of each part, fitted to peaks of nine models of columns of cells, of 21,000 to
# 80,000 unknowns (misfits up to 1.4), and of one of tetrahedra.
_PER_ENTRY = 80.0  # of the element matrices: values, rows, columns, and copies to sort
_PER_ENTRY_OF_TETRAHEDRA = 150.0
_PER_PRODUCT = 110.0  # of a cell's reference matrix, at each of its quadrature points
_PER_POINT = 300.0  # deformation gradients and tensors
_PER_FACTOR = 7.5  # numbers of both factors, and their rows


class Fields(NamedTuple):
    """Potentials and current densities per unit current into each electrode.

    The current leaves through all electrodes in equal parts, so that the difference of two
    electrodes' entries belongs to a drive pair. Potentials are relative to the mean of the
    electrode potentials.

    Attributes:
        potentials: potentials at the points of the mesh, (points, electrodes) [V/A].
        electrode_potentials: impedance matrix, (electrodes, electrodes): potential of the first
            electrode per current into the second [V/A].
        current_densities: mean in each cell of the flat body, (cells, 3, electrodes) [1/m2].
    """

    potentials: Numbers
    electrode_potentials: Numbers
    current_densities: Numbers


class Rule(NamedTuple):
    """Quadrature rule in all cells, with c cells in an element and q points in each cell.

    Attributes:
        X: reference points, cell by cell, (3, c q).
        weights: weights on the reference element, (c q,).
        points: images of the reference points, (cells, q, 3) [m].
    """

    X: Array
    weights: Array
    points: Array


class FunctionSpace:
    """Continuous functions on a mesh, with affine maps from one reference element.

    An element is a column of cells of an extruded mesh, or one tetrahedron.

    Attributes:
        element: shape functions on the reference element.
        unknowns: number of unknowns, without those of inner functions.
        numbers: unknown of each outer function, (elements, outer functions).
        origins: images of X = 0, (elements, 3) [m].
        inverses: dX/dx, (elements, 3, 3).
        jacobians: |det dx/dX|, (elements,).
        rule: quadrature of products of two functions' gradients.
        full_rule: the same, without reduction in the plane.
    """

    def __init__(self, mesh: Mesh, order: tuple[int, ...]) -> None:
        """Number the unknowns for elements of `order`, one number for tetrahedra."""
        if mesh.heights is None:
            self._tetrahedra(mesh, order)
        else:
            self._columns(mesh, mesh.heights, order)
        self.rule = self._rule(*self.element.rule())
        self.full_rule = self._rule(*self.element.full_rule())

    def _tetrahedra(self, mesh: Mesh, order: tuple[int, ...]) -> None:
        if len(order) != 1:
            raise ConfigurationError(
                f"expected one order for tetrahedra, (1,) or (2,), got {order}; tetrahedra have no "
                "separate order along the height"
            )
        element = TetrahedralElement(order[0])
        grid = skfem.MeshTet(
            np.ascontiguousarray(mesh.points.T), np.ascontiguousarray(mesh.cells.T)
        )
        dofs = skfem.Dofs(grid, element.element)
        self.element: Element = element
        self.numbers: Indices = dofs.element_dofs.T.astype(np.int64)
        self.unknowns = int(dofs.N)
        corners = mesh.points[grid.t.T]
        self._map(corners[:, 0], corners[:, 1:] - corners[:, :1])

    def _columns(self, mesh: Mesh, heights: Array, order: tuple[int, ...]) -> None:
        levels, base = len(heights), mesh.cells.shape[1] // 2
        flat = np.ascontiguousarray(mesh.points[::levels, :2].T)
        cells = np.ascontiguousarray(mesh.cells[:: levels - 1, :base].T // levels)
        # Squares keep their corners' order, which gives shared edges one direction on a
        # structured mesh; triangles are sorted by scikit-fem, which does so on any mesh.
        grid = (
            skfem.MeshTri(flat, cells) if base == 3 else skfem.MeshQuad(flat, cells, sort_t=False)
        )
        lateral = np.ptp(mesh.contacts.corners[..., 2], axis=1) > 0.0
        element = ExtrudedElement(
            base="triangle" if base == 3 else "quadrilateral",
            order=order,
            heights=tuple(heights.tolist()),
            condensed=bool(lateral.all()),
        )
        self.element = element
        degree, i, mode = element.functions.T
        dofs = [skfem.Dofs(grid, plane) for plane in element.planes]
        offsets = np.cumsum([0] + [each.N * element.modes(d) for d, each in enumerate(dofs)])
        numbers = np.stack(
            [
                offsets[d] + dofs[d].element_dofs[k] * element.modes(d) + m
                for d, k, m in zip(degree, i, mode, strict=True)
            ],
            axis=1,
        )
        outer = numbers[:, : numbers.shape[1] - element.inner]
        outer_columns, renumbered = np.unique(outer, return_inverse=True)
        self.numbers = renumbered.reshape(outer.shape)
        self.unknowns = len(outer_columns)
        corners = grid.p.T[grid.t.T]
        columns = np.zeros((len(corners), 3, 3))
        columns[:, :2, :2] = corners[:, [1, -1]] - corners[:, :1]
        columns[:, 2, 2] = 1.0
        self._map(np.pad(corners[:, 0], ((0, 0), (0, 1))), columns)

    def _map(self, origins: Array, edges: Array) -> None:
        """Set the affine maps x = origin + X edges of all elements."""
        self.origins: Array = origins
        self._edges: Array = edges
        self.inverses: Array = np.asarray(np.linalg.inv(edges.swapaxes(1, 2)), dtype=np.float64)
        volumes = np.asarray(np.linalg.det(edges), dtype=np.float64)
        self.jacobians: Array = np.abs(volumes)

    def _rule(self, X: Array, weights: Array) -> Rule:
        points: Array = self.origins[:, None] + X.T @ self._edges
        return Rule(X, weights, points.reshape(len(points) * self.element.cells, -1, 3))

    def reference(self, elements: Indices, points: Array) -> Array:
        """Reference points X, (3, n, ...), of `points` (n, ..., 3) [m] in `elements` (n,)."""
        moved = points - np.expand_dims(self.origins[elements], tuple(range(1, points.ndim - 1)))
        X: Array = np.einsum("nab,n...b->an...", self.inverses[elements], moved)
        return X

    def plane_corners(self) -> Array:
        """Corners of the columns' triangles seen from above, (elements, 3, 2) [m]."""
        first = self.origins[:, None, :2]
        return np.concatenate([first, first + self._edges[:, :2, :2]], axis=1)

    @property
    def plane_degree(self) -> int:
        """Degree in the plane to which `rule` is exact on prisms."""
        element = self.element
        if not isinstance(element, ExtrudedElement):
            raise TypeError(f"expected a mesh of columns of cells, got {element}")
        return 2 * max(element.order)

    def upright_rule(self) -> tuple[Array, Array]:
        """Heights and weights of `rule` along a column of cells, (q,) [m] each."""
        heights, level = np.unique(self.rule.X[2], return_inverse=True)
        # Weights of the plane add up to one half, the area of the unit triangle.
        return heights, np.asarray(2.0 * np.bincount(level, self.rule.weights), dtype=np.float64)

    def in_elements(self, potentials: Numbers, inner: Numbers) -> Numbers:
        """Coefficients element by element, (elements, functions, k), from unknowns (unknowns, k).

        `inner` are the matrices of `Stiffness.inner` from outer to inner unknowns.
        """
        outer = potentials[self.numbers]
        return np.concatenate([outer, inner @ outer], axis=1)

    def column_gradients(
        self, potentials: Numbers, elements: Indices, plane: Array, heights: Array
    ) -> Numbers:
        """Gradients of u_k at q heights above p points in each of n columns, (n, 3, p, q, k).

        Args:
            potentials: coefficients of u_k element by element, (elements, functions, k).
            elements: numbers of the columns, (n,).
            plane: x and y of the points in each column, (n, p, 2) [m].
            heights: the same above every point, (q,) [m].
        """
        element, inverses = self.element, self.inverses[elements]
        if not isinstance(element, ExtrudedElement):
            raise TypeError(f"expected a mesh of columns of cells, got {element}")
        moved = plane - self.origins[elements, None, :2]
        X = np.einsum("nab,npb->anp", inverses[:, :2, :2], moved)
        slopes = element.column_gradients(potentials[elements], X, heights)
        # One product for all points of a column.
        gradients: Numbers = inverses.swapaxes(1, 2) @ slopes.reshape(len(elements), 3, -1)
        return gradients.reshape(slopes.shape)


def estimated_memory(space: FunctionSpace) -> float:
    """Peak memory of one frame [byte], from the numbers of unknowns, entries and points.

    The factors of n unknowns with b unknowns in each column of cells have about
    1.25 n b log2(n / b) entries, as those of a plane mesh (nested dissection, George 1973), and
    8.6 n^(4/3) entries for tetrahedra, as those of a body.
    """
    elements, outer = space.numbers.shape
    functions, n = space.element.most_in_cell, float(space.unknowns)
    in_element = len(space.rule.weights)
    if isinstance(space.element, ExtrudedElement):
        across, per_entry = n / elements, _PER_ENTRY
        factors = 1.25 * n * across * max(1.0, math.log2(n / across))
    else:
        factors, per_entry = 8.6 * n ** (4.0 / 3.0), _PER_ENTRY_OF_TETRAHEDRA
    needed: float = (
        per_entry * elements * math.comb(outer + 1, 2)
        + _PER_PRODUCT * math.comb(functions + 1, 2) * in_element
        + _PER_POINT * elements * in_element
        + _PER_FACTOR * factors
    )
    return needed


def fits_memory(space: FunctionSpace) -> bool:
    """Whether the matrices of functions need at most `MAX_MEMORY`."""
    return estimated_memory(space) <= MAX_MEMORY


class MemoryLimitError(ConfigurationError):
    """A mesh whose matrices need more memory than is allowed."""


def require_memory(space: FunctionSpace) -> None:
    """Raise MemoryLimitError for functions whose matrices need more than `MAX_MEMORY`."""
    if not fits_memory(space):
        needed = estimated_memory(space)
        raise MemoryLimitError(
            f"a forward model of {space.unknowns} unknowns needs about {needed / 1e9:.3g} GB of "
            f"memory, more than the {MAX_MEMORY / 1e9:g} GB that are allowed; choose a faster "
            "resolution or larger cells; presses by small indenters need small cells"
        )
