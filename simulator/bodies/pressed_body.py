"""Presses on a body of any shape on a rigid base."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator.bodies.tetrahedral_solid import (
    TetrahedralField,
    TetrahedralSolid,
    body_grading,
    mesh_body,
    require_surface,
)
from eitskin.simulator.mechanics.face import PenaltyContact
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.load_stepping import Load, SolidError, follow, newton
from eitskin.simulator.scene.scene import Touch

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]

MAX_TOUCHES = 4
_PER_RADIUS = 4.0  # cells along the radius of an indenter, under the indenter
# Pressure over entry into the indenter, relative to shear modulus over radius of contact. More
# would lock the cells that the rim cuts.
_CONTACT_STIFFNESS = 500.0
_FIRST_RADIUS, _FIRST_POINTS = 0.4, 12  # of the contact at the start, in radii of the indenter
_SHALLOW = 0.02  # depth of the first presses, over the radius of the indenter
_STARTS = 4  # attempts at the first presses, each half as deep
_FIRST_STEP, _REMEDY = 0.15, "Press it less, or with a larger indenter"
_CONTACT_REACH = 2.0  # radii of an indenter within which the body may touch it
_UPWARD = 0.05  # least upward part of the normals of faces that an indenter may touch
# Boundary within these parts of the body's height from its lowest point rests on the base: where
# the body has a level face there, and where not.
_LEVEL, _SOCKET = 1e-3, 0.05
_FLAT = 0.01  # of its bounding box, that a level face fills at least
# of the body's height, by which touched faces may lie below the highest one
_MAX_HIDDEN_DEPTH = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class PressedBody:
    """Equilibrium of a pressed body.

    Attributes:
        field: displacement and mean stress of the body, a Deformation.
        forces: forces on each indenter [N].
        depths: depths of the indenters below the positions where they first touch the body [m].
        contact_areas: contact areas on the deformed face [m2].
        peak_pressures: peak pressures on the deformed face, at the quadrature points [Pa].
        thinnings: 1 - height over undeformed height of the body on each axis.
    """

    field: TetrahedralField
    forces: Array
    depths: Array
    contact_areas: Array
    peak_pressures: Array
    thinnings: Array


class BodyPress:
    """Body on a rigid base, meshed for one to four indenters that press from above.

    The base holds the boundary nearest to the lowest point: the level face there, or, where the
    body has none, all within a twentieth of its height, as a socket would. The rest of the boundary
    is free; contact of the body with itself or with the base is not solved.

    Attributes:
        body: the meshed body.
        touches: the indenters, with a force or a depth each, held and releases left out.
    """

    def __init__(
        self,
        design: SensorDesign,
        touches: Sequence[Touch],
        mechanics: Mechanics | None = None,
        grading: Grading | None = None,
    ) -> None:
        """Mesh the body.

        Args:
            design: the sensor, with a surface as outline.
            touches: one to four.
            mechanics: materials; only the gel's law and bulk ratio are used.
            grading: finest under the indenters, `layers` is not used; a quarter of the smallest
                radius when omitted.

        Raises ConfigurationError for a plane outline, or a body that needs too many cells.
        """
        surface, self._mechanics = require_surface(design), mechanics or Mechanics()
        self._points, self._faces = surface.triangles()
        self._bounds = surface.bounds
        self.touches = tuple(touches)
        self._lowest = [self._first_contact(touch) for touch in self.touches]
        smallest = min(t.indenter.rims[1] for t in self.touches)
        grading = grading or body_grading(design, smallest / _PER_RADIUS)
        near = np.concatenate([self._points_below(t, grading.finest) for t in self.touches])
        self.body = TetrahedralSolid(mesh_body(design, grading, near), self._mechanics)
        self._fixed = np.sort(self.body.solid.displacement_unknowns(self._base()))
        self._contacts = [self._contact(number) for number in range(len(self.touches))]

    def equilibrium(self) -> PressedBody:
        """Equilibrium under the force [N] or at the depth [m] of each touch, by load stepping.

        Loads rise together from shallow presses, which are solved by their depths: without contact
        nothing holds an indenter under a force.

        Raises SolidError, with the fraction of the load that was carried, where no stable
        equilibrium is found.
        """
        deep = np.array([np.nan if t.depth is None else t.depth for t in self.touches])
        held, final = np.isfinite(deep), np.array([t.force for t in self.touches])
        x, shallow = self._shallow_start(deep)
        contacts = [contact.advance(x) for contact in self._contacts]
        carried = np.array([contact.force(x) for contact in contacts])

        def path(t: float) -> Load:
            forces = np.where(held, 0.0, carried + t * (final - carried))
            return self._load(held, shallow + t * (deep - shallow), forces)

        terms = self.body.solid, *contacts
        x, (_, *balanced) = follow(terms, x, path, _FIRST_STEP, remedy=_REMEDY)
        return self._result(x, [cast("PenaltyContact", contact) for contact in balanced])

    def _shallow_start(self, deep: Array) -> tuple[Array, Array]:
        """Unknowns of shallow presses, and their depths (touches,) [m]; `deep` are those wanted.

        They are made shallower, down to mere contact, where cells turn inside out.
        """
        terms = self.body.solid, *self._contacts
        radii = np.array([touch.indenter.rims[1] for touch in self.touches])
        touching = np.array(
            [
                contact.depth_touching(_FIRST_RADIUS * radius, _FIRST_POINTS)
                for contact, radius in zip(self._contacts, radii, strict=True)
            ]
        )
        failed = SolidError("no shallow press was tried", 0.0)
        for part in 0.5 ** np.arange(_STARTS):
            shallow = np.fmin(touching + part * _SHALLOW * radii, 0.5 * deep)
            start = np.append(np.zeros(self.body.solid.unknowns), shallow)
            load = self._load(np.ones(len(shallow), dtype=bool), shallow, 0.0 * shallow)
            try:
                return newton(terms, start, load), shallow
            except SolidError as error:
                failed = error
        raise failed

    def _load(self, at_depth: Flags, depths: Array, forces: Array) -> Load:
        """Load of touches (touches,) that are held at depths [m], and of forces [N] on others."""
        unknowns = self.body.solid.unknowns
        fixed = np.append(self._fixed, unknowns + np.flatnonzero(at_depth))
        values = np.append(np.zeros(len(self._fixed)), depths[at_depth])
        return Load(fixed, values, np.append(np.zeros(unknowns), forces))

    def _first_contact(self, touch: Touch) -> float:
        """Height of the indenter's lowest point at first contact [m]."""
        axis = np.array([touch.x, touch.y])
        net = axis + touch.indenter.rims[1] * _net()
        z = heights(self._points[self._faces], net)
        rise = touch.indenter.profile(np.linalg.norm(net - axis, axis=1))[0]
        return float(np.nanmax(z - rise))

    def _points_below(self, touch: Touch, finest: float) -> Array:
        """Points on the body under the indenter, two finest sizes apart, (k, 3) [m]."""
        radius = touch.indenter.rims[1]
        steps = np.arange(-radius, radius + finest, 2.0 * finest)
        x, y = (each.ravel() for each in np.meshgrid(steps, steps))
        inside = np.hypot(x, y) <= radius
        turn = np.linspace(0.0, 2.0 * np.pi, 1 + math.ceil(np.pi * radius / finest))
        rim = radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        plane = np.concatenate([np.stack([x, y], axis=1)[inside], rim])
        plane += np.array([touch.x, touch.y])
        z = heights(self._points[self._faces], plane)
        return np.column_stack([plane, z])[~np.isnan(z)]

    def _base(self) -> Indices:
        """Nodes that rest on the base."""
        body, low = self.body, self._bounds[0, 2]
        extent = self._bounds[1] - self._bounds[0]
        above = self._points[self._faces, 2].max(axis=1) - low
        level = self._points[self._faces[above < _LEVEL * extent[2]]]
        a, b = level[:, 1] - level[:, 0], level[:, 2] - level[:, 0]
        area = 0.5 * float(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum())
        flat = area > _FLAT * float(extent[0] * extent[1])
        limit = low + (_LEVEL if flat else _SOCKET) * extent[2]
        nodes = body.solid.facet_nodes(body.facets)
        held: Indices = nodes[body.solid.nodes[nodes, 2] <= limit]
        return held

    def _contact(self, number: int) -> PenaltyContact:
        """Penalty contact of one indenter at rest with the faces that it may touch."""
        body, touch = self.body, self.touches[number]
        centre, radius = np.array([touch.x, touch.y]), touch.indenter.rims[1]
        chosen = body.normals[:, 2] > _UPWARD
        chosen &= np.linalg.norm(body.middles[:, :2] - centre, axis=1) < _CONTACT_REACH * radius
        top = np.full(len(chosen), np.inf)
        top[chosen] = heights(self._points[self._faces], body.middles[chosen, :2])
        slack = _MAX_HIDDEN_DEPTH * float(self._bounds[1, 2] - self._bounds[0, 2])
        chosen &= ~(body.middles[:, 2] < top - slack)  # true where no height was found
        stiffness = _CONTACT_STIFFNESS * self._mechanics.gel.shear_modulus / radius
        return PenaltyContact.from_facets(
            body.solid,
            body.facets[chosen],
            touch.indenter,
            stiffness,
            centre,
            number,
            self._lowest[number],
        )

    def _result(self, x: Array, contacts: Sequence[PenaltyContact]) -> PressedBody:
        solid, count = self.body.solid, len(self.touches)
        field = self.body.field(x)
        thinnings = np.array([self._thinning(field, touch) for touch in self.touches])
        areas, peaks = np.array([contact.area_and_peak(x) for contact in contacts]).T
        return PressedBody(
            field=field,
            forces=np.array([contact.force(x) for contact in contacts]),
            depths=x[solid.unknowns : solid.unknowns + count].copy(),
            contact_areas=areas,
            peak_pressures=peaks,
            thinnings=thinnings,
        )

    def _thinning(self, field: TetrahedralField, touch: Touch) -> float:
        """1 - deformed over undeformed height between the lowest and highest face on the axis."""
        axis = np.array([[touch.x, touch.y]])
        (top,) = heights(self._points[self._faces], axis)
        (bottom,) = -heights(self._points[self._faces] * [1.0, 1.0, -1.0], axis)
        ends = field.positions(np.array([[*axis[0], bottom], [*axis[0], top]]))
        return float(1.0 - (ends[1, 2] - ends[0, 2]) / (top - bottom))


def _net() -> Array:
    """Points (k, 2) of the unit disc, on rings."""
    radii, turn = np.linspace(0.0, 1.0, 21), np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    r, angle = (each.ravel() for each in np.meshgrid(radii, turn))
    return np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)


def require_over_body(surface: Surface, touch: Touch) -> None:
    """Raise ConfigurationError for a touch next to the body."""
    points, faces = surface.triangles()
    if np.isnan(heights(points[faces], np.array([[touch.x, touch.y]]))).any():
        (x, y, _), (end, far, _) = surface.bounds.tolist()
        raise ConfigurationError(
            f"a touch must lie above the body, which reaches from x = {x:g} to {end:g} m and from "
            f"y = {y:g} to {far:g} m, got ({touch.x:g}, {touch.y:g}) m; positions are those of the "
            "surface's file times its scale"
        )


def heights(triangles: Array, places: Array) -> Array:
    """Greatest height of triangles (n, 3, 3) above places (k, 2) [m], (k,); NaN next to them."""
    heights_found = np.full(len(places), np.nan)
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    doubled = _cross(b - a, c - a)
    low, high = triangles[..., :2].min(axis=1), triangles[..., :2].max(axis=1)
    slack = 1e-9 * float(np.ptp(triangles[..., :2]))
    for k, place in enumerate(places):
        near = np.all((low <= place + slack) & (high >= place - slack), axis=1) & (doubled != 0.0)
        first_weight = _cross(place - a[near, :2], c[near] - a[near]) / doubled[near]
        other = _cross(b[near] - a[near], place - a[near, :2]) / doubled[near]
        inside = (first_weight >= -1e-9) & (other >= -1e-9) & (first_weight + other <= 1.0 + 1e-9)
        if inside.any():
            first = a[near, 2][inside]
            z = first + first_weight[inside] * (b[near, 2][inside] - first)
            z += other[inside] * (c[near, 2][inside] - first)
            heights_found[k] = z.max()
    return heights_found


def _cross(a: Array, b: Array) -> Array:
    product: Array = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return product
