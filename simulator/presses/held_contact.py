"""Held contact: the area under a rough indenter, which moves with the indenter only."""

import math
from collections.abc import Callable

import numpy as np
import skfem
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array

from eitskin.simulator.mechanics.mixed_solid import Solid
from eitskin.simulator.presses.contact_frame import ContactFrame
from eitskin.simulator.scene.indenters import Indenter

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_PARTS = 12  # of a facet that the rim may cut, along each side, with 2 x 2 points each


class HeldContact:
    """Springs that hold the displacement c of a contact area at -d n - g.

    n is the normal of the face, and g the displacement of the area by the dents of other indenters
    and by the curvature of a bend. The indenter neither tilts nor moves sideways, and sinks by a
    further d under a force unchanged.
    A smooth indenter holds c along its normal only. The unknown d [m] follows those of the solid.

    Attributes:
        area: of the contact on the undeformed face [m2].
    """

    def __init__(
        self,
        solid: Solid,
        facets: Indices,
        indenter: Indenter,
        centre: Array,
        radius: float,
        stiffness: float,
        number: int,
        given: Callable[[Array], Array] | None = None,
        frame: ContactFrame | None = None,
    ) -> None:
        """Integrate the springs over a circle on a face that is level before any bend.

        Args:
            solid: the body.
            facets: boundary facets of its mesh that the contact may reach.
            indenter: gives the normal, and whether it is rough.
            centre: of the contact, (2,) [m].
            radius: of the undeformed contact [m].
            stiffness: of the springs [Pa/m].
            number: of the contact, among those of the solid.
            given: g (n, 3) [m] at points (n, 3) of the face; none when omitted.
            frame: of the bent face, on which the contact is a circle; of a level one when omitted.
        """
        basis = skfem.FacetBasis(
            solid.mesh, solid.basis.elem, facets=facets, quadrature=_composite_rule()
        )
        away = np.asarray(basis.global_coordinates())[:2] - centre[:, None, None]
        turn = np.eye(3)
        if frame is not None:
            away, turn = away * frame.stretches[:, None, None], frame.rotation
        r = np.linalg.norm(away, axis=0)
        weights = np.asarray(basis.dx) * (r < radius)
        self.area = float(weights.sum())
        functions = [np.broadcast_to(np.asarray(f), r.shape) for (f,) in basis.basis]
        values = np.stack([*functions, np.ones_like(r)], axis=-1)
        held = turn @ _held(indenter, away, r) @ turn.T
        shares = values * (stiffness * weights)[..., None]
        # A rough indenter holds all directions alike, with a ninth of the work.
        K = (
            np.einsum("fqa,fqb,ij->faibj", shares, values, held, optimize=True)
            if held.ndim == 2
            else np.einsum("fqa,fqij,fqb->faibj", shares, held, values, optimize=True)
        )
        dofs = basis.element_dofs.T.astype(np.int64)
        numbers = (3 * dofs[:, :, None] + np.arange(3)).reshape(len(dofs), -1)
        numbers = np.hstack([numbers, np.full((len(dofs), 1), solid.unknowns + number)])
        # The last of the vectors that are added up is d n.
        sink = np.eye(3 * values.shape[-1])[:, : numbers.shape[1]]
        sink[-3:, -1] = turn[:, 2]
        K = sink.T @ K.reshape(len(dofs), len(sink), len(sink)) @ sink
        rows = np.broadcast_to(numbers[:, :, None], K.shape).ravel()
        columns = np.broadcast_to(numbers[:, None, :], K.shape).ravel()
        self._entries = (K.ravel(), (rows, columns))
        self._stiffness: csc_array | None = None
        self._given: tuple[Indices, Array] | None = None
        if given is not None:
            points = np.moveaxis(np.asarray(basis.global_coordinates()), 0, -1)
            g = given(points.reshape(-1, 3)).reshape(points.shape)
            pulled = np.einsum("fqa,fqi->fai", shares, (held @ g[..., None])[..., 0])
            self._given = numbers.ravel(), (pulled.reshape(len(dofs), -1) @ sink).ravel()

    @property
    def multipliers(self) -> int:
        """Number of Lagrange multipliers: none, since springs need no multipliers."""
        return 0

    def admissible(self, x: Array) -> bool:  # noqa: ARG002
        """Always true: springs allow any position."""
        return True

    def advanced(self, x: Array) -> "HeldContact":  # noqa: ARG002
        """The contact itself, which has no history."""
        return self

    def forces(self, x: Array) -> Array:
        """Forces of the springs on the unknowns (n,) [N]."""
        found = np.asarray(self._matrix(len(x)) @ x)
        if self._given is not None:
            np.add.at(found, *self._given)
        return found

    def linearise(self, x: Array) -> tuple[Array, csc_array]:
        """Forces (n,) and their constant stiffness (n, n)."""
        return self.forces(x), self._matrix(len(x))

    def _matrix(self, size: int) -> csc_array:
        if self._stiffness is None or self._stiffness.shape[0] != size:
            self._stiffness = coo_array(self._entries, shape=(size, size)).tocsc()
        return self._stiffness


def _composite_rule() -> tuple[Array, Array]:
    """Points (2, q) and weights (q,) of Gauss rules on equal parts of the unit square."""
    gauss = 0.5 + np.array([-0.5, 0.5]) / math.sqrt(3.0)
    line = ((np.arange(_PARTS)[:, None] + gauss) / _PARTS).ravel()
    points = np.stack(np.meshgrid(line, line, indexing="ij")).reshape(2, -1)
    return points, np.full(points.shape[1], 1.0 / points.shape[1])


def _held(indenter: Indenter, away: Array, r: Array) -> Array:
    """Projections (facets, q, 3, 3) on the directions in which points are held; (3, 3) for all."""
    if indenter.rough:
        return np.eye(3)
    slope = indenter.profile(r)[1]
    normal = np.stack([*(-slope * away / np.maximum(r, 1e-12)), np.ones_like(r)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    projections: Array = normal[..., :, None] * normal[..., None, :]
    return projections
