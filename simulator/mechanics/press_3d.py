"""Full 3D model of presses: indenters on the encapsulated gel on a rigid base."""

import itertools
import math
from collections.abc import Iterator, Sequence

import numpy as np
import skfem
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.grading import Grading, graded_lines
from eitskin.simulator.linalg.nested_dissection import Block, by_blocks, dissected
from eitskin.simulator.mechanics.dented_stack import DentedStack
from eitskin.simulator.mechanics.initial_guess import UnboundedPress
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.load_stepping import ForceTerm, Load, SolidError, newton
from eitskin.simulator.mechanics.mixed_solid import Solid
from eitskin.simulator.mechanics.penalty_contact import PenaltyContact
from eitskin.simulator.mechanics.press_window import PressWindow, check_touches
from eitskin.simulator.mechanics.quadratic_field import QuadraticField
from eitskin.simulator.scene.touch import Touch

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_SAME = 1e-9  # [m]
_ROUNDED = 10  # decimals, in m, by which nodes of one plane agree
# Pressure over entry into the indenter, relative to shear modulus over radius of contact. More
# would lock the cells that the rim cuts.
_CONTACT_STIFFNESS = 500.0
_FIRST_STEP, _GROWTH, _SMALLEST_STEP = 0.05, 10.0, 0.01
_NEAR = 2.0  # radii of an indenter within which the top may touch it


class PressedStack:
    """Flat sensor bonded to a rigid base, pressed from above by one to four indenters.

    The sides of the encapsulation are free, and so is its top outside the contacts. Beyond
    `reach` from the touches nothing moves. Along an axis of symmetry only half is solved.

    Attributes:
        touches: the indenters, their positions and forces.
        windows: computational windows along x and y.
        solid: the meshed windows, in coordinates from their origins and the gel's lower face.
    """

    def __init__(
        self,
        design: SensorDesign,
        touches: Sequence[Touch],
        mechanics: Mechanics | None = None,
        grading: Grading | None = None,
        reach: float | None = None,
    ) -> None:
        """Mesh the windows by boxes.

        Args:
            design: the sensor, of rectangular outline.
            touches: one to four, on the gel, whose indenters do not overlap.
            mechanics: materials.
            grading: finest under the indenters, `layers` cells in each of encapsulation, gel and
                encapsulation; by the smallest indenter and the thickness when omitted.
            reach: distance along x or y beyond which nothing moves; five thicknesses of the
                sensor when omitted [m].
        """
        outline, self._mechanics = design.outline, mechanics or Mechanics()
        if not isinstance(outline, Rectangle):
            raise ConfigurationError(
                f"a pressed stack needs a rectangular outline, got {type(outline).__name__}"
            )
        check_touches(outline, touches)
        self.touches = tuple(touches)
        self._stack = self._mechanics.stack(design)
        thickness = design.encapsulated_thickness
        reach = 5.0 * thickness if reach is None else reach
        grading = grading or press_grading(thickness, touches)
        margin, around = self._mechanics.margin, 0.5 * (thickness - design.thickness)
        self._gel = np.array([outline.length, outline.width, design.thickness])
        beyond = np.array([margin, margin, around])
        self._sensor = np.array([-beyond, self._gel + beyond])
        self.windows = (
            PressWindow.around(touches, 0, (-margin, outline.length + margin), reach),
            PressWindow.around(touches, 1, (-margin, outline.width + margin), reach),
        )
        self._lines = (
            self._across(0, grading),
            self._across(1, grading),
            _heights(self._sensor[0, 2], self._gel[2], self._sensor[1, 2], grading.layers),
        )
        self.solid = self._meshed()
        self._fixed = self._supports()
        self._pressures = self._numbered()
        self._kept = [t for t in self.touches if self._solves(t)]
        self._shares = np.array([self._share(touch) for touch in self._kept])
        self._eliminate = by_blocks(self._blocks())

    def equilibria(self, fractions: Sequence[float] = (1.0,)) -> Iterator[DentedStack]:
        """Equilibria under rising fractions of all forces, by load stepping.

        Raises SolidError, with the fraction of the load that was carried, where no stable
        equilibrium is found.
        """
        x = np.zeros(self.solid.unknowns + len(self._kept))
        contacts, before = self._contacts(), 0.0
        for fraction in fractions:
            if not fraction > before:
                raise ConfigurationError(f"fractions of a load must rise from 0, got {fractions}")
            x, contacts = self._load_stepped(x, contacts, before, fraction)
            before = fraction
            yield self._result(x, contacts)

    def _load_stepped(
        self, x: Array, contacts: list[PenaltyContact], before: float, after: float
    ) -> tuple[Array, list[PenaltyContact]]:
        """Load stepping from one fraction of the load to another, with adaptive steps.

        Each step starts from the superposed presses on an unbounded stack.
        """
        reached, guessed = before, self._initial_guess(before)
        target = min(after, _GROWTH * before or _FIRST_STEP)
        while reached < after:
            try:
                there = self._initial_guess(target)
                guess = x + there - guessed
                start = guess if self.solid.admissible(guess) else x
                terms: list[ForceTerm] = [self.solid, *contacts]
                moved = newton(terms, start, self._load(target), self._eliminate)
            except SolidError as error:
                target = 0.5 * (reached + target)
                if target - reached < _SMALLEST_STEP * after:
                    raise SolidError(
                        f"the sensor carries {reached:.0%} of these presses only; beyond, {error}. "
                        "Press it less, or refine the mesh",
                        reached=reached,
                    ) from None
                continue
            x, guessed, reached = moved, there, target
            target = min(after, _GROWTH * reached)
            contacts = [contact.advanced(x) for contact in contacts]
        return x, contacts

    def _across(self, axis: int, grading: Grading) -> Array:
        """Grid lines along x or y from the origin of the window, fine under the indenters [m]."""
        window = self.windows[axis]
        under, ends = [], np.array([0.0, self._gel[axis]])
        for touch in self.touches:
            place, radius = (touch.x, touch.y)[axis], touch.indenter.rims[1]
            cells = 2 * math.ceil(radius / grading.finest - _SAME)
            under.append(np.linspace(place - radius, place + radius, cells + 1))
        edges, breaks = np.concatenate(under) - window.origin, ends - window.origin
        inside = (breaks > _SAME) & (breaks < window.extent - _SAME)
        within = (edges > -_SAME) & (edges < window.extent + _SAME)
        return graded_lines(window.extent, edges[within], breaks[inside], grading)

    def _meshed(self) -> Solid:
        mesh = skfem.MeshHex.init_tensor(*self._lines)
        middles = mesh.p[:, mesh.t].mean(axis=1).T
        middles[:, 0] += self.windows[0].origin
        middles[:, 1] += self.windows[1].origin
        gel = np.all((middles > 0.0) & (middles < self._gel), axis=1)
        laws = (self._mechanics.encapsulation, self._mechanics.gel)
        return Solid(mesh, laws, gel.astype(np.int64), "solid", self._mechanics.bulk_ratio)

    def _supports(self) -> Indices:
        """Prescribed unknowns: all at base and cuts, the normal ones on planes of symmetry."""
        X = self.solid.nodes
        held = X[:, 2] < self._lines[2][0] + _SAME
        mirrored = []
        for axis, window in enumerate(self.windows):
            if window.cut[0] and not window.mirrored:
                held |= X[:, axis] < _SAME
            if window.cut[1]:
                held |= X[:, axis] > window.extent - _SAME
            if window.mirrored:
                mirrored.append(3 * np.flatnonzero(X[:, axis] < _SAME) + axis)
        moved = (3 * np.flatnonzero(held)[:, None] + np.arange(3)).ravel()
        return np.unique(np.concatenate([moved, *mirrored]))

    def _numbered(self) -> list[tuple[Indices, Array]]:
        """Numbers and positions of the pressures of each layer, its margin included."""
        solid, laws = self.solid, len(self.solid.laws)
        corners = [solid.mesh.t[:, cells] * laws + k for k, cells in enumerate(solid.cells_of_law)]
        kept = np.unique(np.concatenate(corners, axis=1))
        places, gel = solid.mesh.p.T[kept // laws], kept % laws == 1
        below, above = places[:, 2] < _SAME, places[:, 2] > self._gel[2] - _SAME
        layer = np.where(gel | ~(below | above), 1, np.where(below, 0, 2))
        numbers = solid.nodes.size + np.arange(len(kept))
        layers = range(3) if len(self._stack.sheets) == 3 else (1,)
        return [(numbers[layer == k], places[layer == k]) for k in layers]

    def _blocks(self) -> list[Block]:
        """Blocks of free unknowns in the order of elimination."""
        places = np.full((self.solid.unknowns + len(self._kept), 3), np.nan)
        places[: self.solid.nodes.size] = np.repeat(self.solid.nodes, 3, axis=0)
        for numbers, at in self._pressures:
            places[numbers] = at
        free = np.setdiff1d(np.arange(len(places)), self._fixed)
        blocks = dissected(places[free, :2], self._lines[:2])
        return [Block(free[block.own], block.within) for block in blocks]

    def _solves(self, touch: Touch) -> bool:
        """Whether a touch lies in the solved part, not in its mirror image."""
        places = zip((touch.x, touch.y), self.windows, strict=True)
        return all(place > w.origin - _SAME for place, w in places)

    def _share(self, touch: Touch) -> float:
        """Fraction of the indenter in the solved part; a half on each plane of symmetry."""
        places = zip((touch.x, touch.y), self.windows, strict=True)
        return math.prod(0.5 for place, w in places if w.mirrored and place < w.origin + _SAME)

    def _contacts(self) -> list[PenaltyContact]:
        """Penalty contact of the top with each solved indenter, at rest."""
        mesh, found = self.solid.mesh, []
        top = mesh.facets_satisfying(
            lambda X: np.isclose(X[2], self._lines[2][-1]), boundaries_only=True
        )
        middles = mesh.p[:2, mesh.facets[:, top]].mean(axis=1).T
        mu = self._stack.sheets[-1].law.shear_modulus
        for number, touch in enumerate(self._kept):
            centre, radius = self._local(touch), touch.indenter.rims[1]
            near = top[np.linalg.norm(middles - centre, axis=1) < _NEAR * radius]
            stiffness = _CONTACT_STIFFNESS * mu / radius
            found.append(
                PenaltyContact.of_face(self.solid, near, touch.indenter, stiffness, centre, number)
            )
        return found

    def _local(self, touch: Touch) -> Array:
        """Position of a touch, or of its mirror image, in the solved part, (2,) [m]."""
        places = zip((touch.x, touch.y), self.windows, strict=True)
        return np.array([float(w.local(np.array(place))[0]) for place, w in places])

    def _load(self, fraction: float) -> Load:
        forces = np.zeros(self.solid.unknowns + len(self._kept))
        whole = np.array([touch.force for touch in self._kept])
        forces[self.solid.unknowns :] = fraction * self._shares * whole
        return Load(self._fixed, np.zeros(len(self._fixed)), forces)

    def _initial_guess(self, fraction: float) -> Array:
        """Unknowns of superposed presses on an unbounded stack, the initial guess."""
        n, nodes = self.solid.unknowns, self.solid.nodes
        x = np.ones(n + len(self._kept))
        scale = np.nanmax(self.solid.corner_mean_stress(x, 1))  # of a unit of pressure
        x[:] = 0.0
        above = np.array([self.windows[0].origin, self.windows[1].origin, -self._lines[2][0]])
        tops = np.array([[t.x, t.y, self._stack.levels[-1]] for t in self._kept])
        for touch in self.touches if fraction else ():
            press = UnboundedPress.on(self._stack, touch, fraction * touch.force)
            x[: nodes.size] += press.displacement(nodes + above).ravel()
            # An indenter follows the top that the other presses displace.
            own = [touch is kept for kept in self._kept]
            x[n:] += np.where(own, press.press.depth, -press.displacement(tops)[:, 2])
            for layer, (numbers, places) in enumerate(self._pressures):
                x[numbers] += press.mean_stress(places + above, layer) / scale
        x[self._fixed] = 0.0
        return x

    def _result(self, x: Array, contacts: Sequence[PenaltyContact]) -> DentedStack:
        solid, gel = self.solid, self.solid.cells_of_law[1]
        order = np.lexsort(solid.nodes.round(_ROUNDED).T[::-1])
        shape = tuple(2 * len(line) - 1 for line in self._lines)
        field = QuadraticField(self._lines, solid.displacement(x)[order].reshape(*shape, 3))
        J = solid.volume_ratio(x) * solid.weights
        places = np.array([self._local(touch) for touch in self.touches])
        kept = np.array([self._local(touch) for touch in self._kept])
        # Touches that mirror each other have equal results.
        which = np.linalg.norm(places[:, None] - kept, axis=-1).argmin(axis=1)
        faces = [np.insert(places, 2, z, axis=1) for z in (0.0, self._gel[2])]
        lower, upper = (field(face)[:, 2] for face in faces)
        areas, peaks = np.array([contact.area_and_peak(x) for contact in contacts]).T
        forces = np.array([contact.force(x) for contact in contacts]) / self._shares
        copies = math.prod(2 for window in self.windows if window.mirrored)
        upward = self._fixed[(self._fixed % 3 == 2) & (self._fixed < solid.nodes.size)]
        return DentedStack(
            displacement=field,
            windows=self.windows,
            sensor=self._sensor,
            forces=forces[which],
            depths=x[solid.unknowns :][which],
            contact_areas=(areas / self._shares)[which],
            peak_pressures=peaks[which],
            thinnings=(lower - upper) / self._gel[2],
            volume_ratio=float(J[gel].sum() / solid.weights[gel].sum()),
            energy=copies * (solid.energy(x) + sum(contact.energy(x) for contact in contacts)),
            base_force=copies * float(solid.forces(x)[upward].sum()),
        )


def press_grading(thickness: float, touches: Sequence[Touch]) -> Grading:
    """Default grading for a stack of this thickness [m] and the smallest of the indenters."""
    radius = min(touch.indenter.rims[1] for touch in touches)
    return Grading(finest=radius / 6.0, coarsest=0.5 * thickness, growth=0.35)


def _heights(low: float, gel: float, high: float, layers: int) -> Array:
    ends = np.unique([low, 0.0, gel, high])
    parts = [np.linspace(a, b, layers + 1)[1:] for a, b in itertools.pairwise(ends)]
    return np.concatenate([ends[:1], *parts])
