"""Cases of bends, rolls, twists and presses up to their limits and beyond, and of stiff layers.

The bent sensor is a bar between electrodes over two whole faces. Always true: the deformations keep
volume (det F = 1, of presses on average), and a rigid motion afterwards changes nothing; the base
pushes back with the force on an indenter, and every layer keeps its volume.
"""

import dataclasses
import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
import skfem
from numpy.typing import NDArray

from eitskin.benchmarks.stability.case import Case, CaseValues
from eitskin.benchmarks.stability.closed_forms import punched_layer, sector
from eitskin.benchmarks.stability.electrical import OUTLINE, H, L, W, bar
from eitskin.geometry import (
    Bend,
    ConfigurationError,
    Electrode,
    FreeArc,
    Hinge,
    Roll,
    SensorDesign,
    Twist,
)
from eitskin.geometry.deformation.fixtures import Fixture
from eitskin.geometry.deformation.kinematics import Composition, Deformation, pulled_back_entries
from eitskin.geometry.meshing.grading import Grading, graded_lines
from eitskin.simulator import Cylinder, Mechanics, Scene, Simulator, Sphere, Touch
from eitskin.simulator.deformation.press_table import sketched_dents
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.layer_stack import Sheet, Stack
from eitskin.simulator.mechanics.load_stepping import Load, SolidError, newton
from eitskin.simulator.mechanics.materials import NeoHookean
from eitskin.simulator.mechanics.mixed_solid import STIFFEST, Solid
from eitskin.simulator.scene.indenters import Indenter

Array = NDArray[np.float64]

_Z = 1e-9  # contact impedance [ohm m2]
_MESH = ((2, 2, 2), Grading(1e-2, 1e-2, 1.0, layers=4))
_CROSS_ELECTRODES = (Electrode(L / 2, 0.0, L, _Z), Electrode(L / 2, W, L, _Z))


FIXTURES: dict[str, Hinge | FreeArc] = {
    "hinge": Hinge(),
    "hinge, axis mid-layer": Hinge(offset=0.0),
    "hinge, axis above": Hinge(offset=-0.008),
    "smooth hinge": Hinge(transition=0.01, contraction=0.8),
    "arc of 20 mm": FreeArc(0.02),
    "smooth arc of 20 mm": FreeArc(0.02, transition=0.005, contraction=1.0),
}
_WAYS = (("up", 1.0), ("down", -1.0))
_LAST = "last possible angle"
QUICK_FIXTURES = ("hinge", "smooth arc of 20 mm")


@dataclass(frozen=True, slots=True)
class _RigidMotion(Deformation):
    """Rigid motion: a rotation and a shift."""

    def map_points(self, points: Array) -> tuple[Array, Array]:
        moved = points @ self._turn().T + np.array([0.3, -2.0, 0.01])
        return moved, np.broadcast_to(self._turn(), (*points.shape, 3))

    def _turn(self) -> Array:
        (c, s), (d, e) = ((math.cos(a), math.sin(a)) for a in (1.0, 2.0))
        about_z = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        about_y = np.array([[d, 0.0, e], [0.0, 1.0, 0.0], [-e, 0.0, d]])
        turn: Array = about_y @ about_z
        return turn


def bends(quick: bool) -> Iterator[Case]:
    """Cases of free arcs to the full circle, and of hinges and short arcs to their last angles."""
    angles = (-180.0, 180.0, 360.0) if quick else (-360.0, -180.0, -90.0, -1e-3, 1e-3, 90.0, 360.0)
    for angle in angles:
        yield Case(f"whole length to {angle:g} deg", partial(_arc, angle))
    for angle in (360.1, -1e6):
        name, solve = f"whole length to {angle:g} deg", partial(_arc, angle)
        yield Case(name, solve, "refused", _LAST)
    for name, fixture in FIXTURES.items():
        for way, sign in () if quick and name not in QUICK_FIXTURES else _WAYS:
            yield Case(f"{name}, {way}, to the end", partial(_end, fixture, sign))
            past = partial(_end, fixture, sign, 0.2)
            yield Case(f"{name}, {way}, past it", past, "refused", _LAST)


def rolls_and_twists(quick: bool) -> Iterator[Case]:
    """Cases of rolls to where the edges meet, and of twists by many turns."""
    for angle in (-180.0, 360.0) if quick else (-360.0, -180.0, -90.0, 90.0, 180.0, 360.0):
        yield Case(f"roll, {angle:g} deg", partial(_roll_bar, angle))
    for angle in (360.1, float("nan")):
        solve = partial(_roll_bar, angle)
        yield Case(f"roll, {angle:g} deg", solve, "refused", "-360 to 360")
    for turns in (0.25, 10, 100, 1000):
        solve = partial(_scene, Scene(twist=Twist(360.0 * turns)))
        # F grows with the turns, and what rounding takes from det F with its cube.
        yield Case(f"twist, {turns:g} turns", solve)


def compositions(quick: bool) -> Iterator[Case]:
    """Cases of presses on bent, rolled and twisted sensors; volume is kept on average."""
    press = (Touch(0.075, 0.030),)
    four = tuple(Touch(x, 0.030) for x in (0.03, 0.06, 0.09, 0.12))
    scenes = {
        "press, arc of 360 deg": Scene(Bend(360.0), press),
        "press, arc of -180 deg": Scene(Bend(-180.0), press),
        "press, roll, bend and twist": Scene(Bend(20.0), press, Roll(20.0), Twist(90.0)),
        "four presses": Scene(touches=four),
    }
    for name, scene in scenes.items():
        solve = partial(_scene, scene, FreeArc(L), quick)
        yield Case(name, solve, invariant_limit=5e-3)
    if not quick:  # sketched dents know no edge
        rim = partial(_scene, Scene(Bend(90.0), (Touch(0.075, 0.0),)), FreeArc(L), quick)
        name = "press on the rim, arc of 90 deg"
        yield Case(name, rim, "refused", "from the edge")
    for gap in (0.016, 0.0):
        name = f"two presses {1e3 * gap:g} mm apart"
        yield Case(name, partial(_two, gap, quick), None, invariant_limit=5e-2)
    rolled = Scene(Bend(90.0), roll=Roll(180.0))
    yield Case("rolled to 180 deg, then bent", partial(_scene, rolled), None)


def _arc(angle: float) -> CaseValues:
    """Bar bent evenly into an annular sector."""
    arc, design = FreeArc(L), bar(_Z)
    flexure = arc.flexure(design, Bend(angle))
    exact = sector(math.radians(angle), H, W, flexure.stretch, L)
    return _bar_values(Simulator(design, _MESH, arc), flexure, lambda R: abs(R / exact - 1.0))


def _roll_bar(angle: float) -> CaseValues:
    """Bar rolled evenly across its width into an annular sector."""
    design = SensorDesign(OUTLINE, H, _CROSS_ELECTRODES)
    rolled = Roll(angle).deformation(design)
    exact = sector(math.radians(angle), H, L, rolled.flexure.stretch, W)
    return _bar_values(Simulator(design, _MESH), rolled, lambda R: abs(R / exact - 1.0))


def _scene(scene: Scene, fixture: Fixture | None = None, quick: bool = True) -> CaseValues:
    """Bar under a scene, its resistance compared with rigorous bounds."""
    sim = Simulator(bar(_Z), _MESH, fixture)
    deformation = sim.deformation(dataclasses.replace(scene, touches=()) if quick else scene)
    if quick and scene.touches:  # dents as for drawings
        dents = sketched_dents(scene.touches, sim.design)
        deformation = Composition(dents, deformation) if deformation else dents
    if deformation is None:
        raise ConfigurationError("the scene does not deform the sensor")
    low, high = _bounds(deformation)
    values = _bar_values(sim, deformation, lambda R: max(low / R, R / high, 1.0) - 1.0)
    if not scene.touches:
        return values
    volume = abs(float(_determinants(deformation).mean()) - 1.0)
    return dataclasses.replace(values, invariant=volume)


def _two(gap: float, quick: bool) -> CaseValues:
    """Two presses near each other, whose dents overlap."""
    touches = tuple(Touch(0.075 + side * gap, 0.030) for side in (-0.5, 0.5))
    return _scene(Scene(touches=touches), FreeArc(L), quick)


def _end(fixture: Hinge | FreeArc, sign: float, past: float = 0.0) -> CaseValues:
    """Bar at the last possible angle, as the refusal of a larger one names it, or past it [deg]."""
    angle = _last_angle(fixture, sign)
    values = _scene(Scene(Bend(angle + sign * past)), fixture)
    return dataclasses.replace(values, reached=f"{angle:g} deg")


@cache
def _last_angle(fixture: Hinge | FreeArc, sign: float) -> float:
    try:
        fixture.flexure(bar(_Z), Bend(1e4 * sign))
    except ConfigurationError as error:
        return float(re.findall(r"last possible .* is (\S+) deg", str(error))[0])
    raise ConfigurationError(f"{fixture} bends by ten thousand degrees")


def _bar_values(
    sim: Simulator, deformation: Deformation, error: Callable[[float], float]
) -> CaseValues:
    """Resistance of the bar, and its change by a rigid motion."""
    R, moved = (
        complex(sim.simulate_deformation(each).impedance[0])
        for each in (deformation, Composition(deformation, _RigidMotion()))
    )
    return CaseValues(
        residual=abs(moved / R - 1.0),
        invariant=float(np.abs(_determinants(deformation) - 1.0).max()),
        error=error(R.real),
    )


def _places() -> tuple[Array, Array]:
    """Gauss points (n, m, 3) [m], section by section, and weights (m,) [m2] of a section."""
    ends = np.linspace(0.0, L, 151)  # of which some are where hinges and arcs begin
    gauss = 0.5 + 0.5 * np.array([-1.0, 1.0]) / math.sqrt(3.0)
    x = ends[:-1, None] + gauss * np.diff(ends)[:, None]
    nodes, weights = np.polynomial.legendre.leggauss(8)
    across, up = 0.5 * W * (nodes + 1.0), 0.5 * H * (nodes + 1.0)
    grid = np.stack(np.meshgrid(x.ravel(), across, up, indexing="ij"), axis=-1)
    section = 0.25 * W * H * np.outer(weights, weights)
    return grid.reshape(len(grid), -1, 3), section.ravel()


def _determinants(deformation: Deformation) -> Array:
    J: Array = np.linalg.det(deformation.gradient(_places()[0]))
    return J


def _bounds(deformation: Deformation) -> tuple[float, float]:
    """Bounds [ohm]: sections of one potential each, and fibres that exchange no current.

    With S = J F^-1 F^-T: int dX / int S_XX dA <= R <= int int (S^-1)_XX dA dX / A^2 (Dirichlet's
    and Thomson's principles).
    """
    points, section = _places()
    entries = pulled_back_entries(deformation.gradient(points))
    S = entries[..., [[0, 3, 4], [3, 1, 5], [4, 5, 2]]]
    step = L / len(points)
    low = float((step / (S[..., 0, 0] @ section)).sum())
    fibres = np.linalg.inv(S)[..., 0, 0] @ section
    return low, float(step * fibres.sum()) / (W * H) ** 2 + 2.0 * _Z / (W * H)


# Nearly incompressible layers, and presses to their limits

Indices = NDArray[np.int64]

_RADIUS, _THICKNESS, _REACH = 0.6, 1.0, 6.0  # of the punch and the layer, in any unit
_DEPTH = 1e-6  # so small that strains are linear
_DEEPEST = 0.9  # of the thickness


def incompressible(quick: bool) -> Iterator[Case]:
    """Cases of a punch on a layer, from compressible to nearly incompressible."""
    for nu in (0.3, 0.499, 0.49999) if quick else (0.3, 0.4, 0.49, 0.499, 0.4999, 0.49999):
        solve = partial(_punch_case, _bulk_ratio(nu))
        yield Case(f"nu = {nu:g}", solve, error_limit=1e-2)
    for ratio in (1e6, STIFFEST):
        solve = partial(_punch_case, ratio)
        yield Case(f"bulk modulus {ratio:g} mu", solve, error_limit=1e-2)
    for ratio in (1e9, 0.0, float("nan")):
        solve = partial(_punch_case, ratio)
        yield Case(f"bulk modulus {ratio:g} mu", solve, "refused", "bulk_ratio must")


def _bulk_ratio(nu: float) -> float:
    """Bulk modulus over shear modulus for Poisson's ratio."""
    return 2.0 * (1.0 + nu) / (3.0 * (1.0 - 2.0 * nu))


def _punch_case(ratio: float) -> CaseValues:
    """Small indentation of a bonded layer by a flat smooth punch."""
    sizes = Grading(4e-3, 0.2, 0.4)
    r = graded_lines(_REACH, (_RADIUS,), (), sizes)
    z = graded_lines(_THICKNESS, (_THICKNESS,), (), sizes)
    solid = Solid(skfem.MeshQuad.init_tensor(r, z), [NeoHookean(1.0)], None, "axisymmetric", ratio)
    held, values = _punch(solid.nodes)
    start = np.zeros(solid.unknowns)
    x = newton([solid], start, Load(held, values, start))
    forces = solid.forces(x)
    nu = (3.0 * ratio - 2.0) / (6.0 * ratio + 2.0)
    exact = _DEPTH * punched_layer(_RADIUS, _THICKNESS, nu)
    push = -forces[held[values < 0.0]].sum()
    back = forces[2 * np.flatnonzero(solid.nodes[:, 1] < 1e-9) + 1].sum()
    free = np.setdiff1d(np.arange(solid.unknowns), held)
    return CaseValues(
        residual=float(np.abs(forces[free]).max() / push),
        invariant=abs(float(back / push) - 1.0),
        error=abs(float(push) / exact - 1.0),
    )


def _fixed_unknowns(nodes: Array) -> Indices:
    """Unknowns fixed by the bonded base, the smooth axis and the wall around."""
    r, z = nodes.T
    sides = 2 * np.flatnonzero((r < 1e-12) | (r > r.max() - 1e-9))
    base = np.flatnonzero(z < 1e-12)
    return np.union1d(sides, np.concatenate([2 * base, 2 * base + 1]))


def _punch(nodes: Array) -> tuple[Indices, Array]:
    """Fixed unknowns, those under the punch last, and their values."""
    r, z = nodes.T
    held = _fixed_unknowns(nodes)
    under = 2 * np.flatnonzero((z > _THICKNESS - 1e-9) & (r < _RADIUS + 1e-9)) + 1
    values = np.concatenate([np.zeros(len(held)), np.full(len(under), -_DEPTH)])
    return np.concatenate([held, under]), values


def presses(quick: bool) -> Iterator[Case]:
    """Cases of presses to a tenth of the thickness, or until no equilibrium is found."""
    stack = Mechanics().stack(SensorDesign.reference())
    gel = Stack((Sheet(0.005, Mechanics().gel),))
    bodies: dict[str, tuple[Stack, Indenter]] = {
        "rough ball, stack": (stack, Sphere(0.0075, rough=True)),
        "rough cylinder, stack": (stack, Cylinder()),
        "smooth ball, stack": (stack, Sphere(0.0075, rough=False)),
        "smooth cylinder, stack": (stack, Cylinder(rough=False)),
        "rough cylinder, gel alone": (gel, Cylinder()),
        "smooth ball, gel alone": (gel, Sphere(0.0075, rough=False)),
    }
    for name in list(bodies)[:1] if quick else bodies:
        finest, steps = (3e-3, 3) if quick else (5e-4, 18)
        solve = partial(_press_case, *bodies[name], finest, steps)
        # Layers change volume by mean pressure over bulk modulus, 1e4 mu.
        limits = {"residual_limit": 1e-6, "invariant_limit": 1e-4}
        yield Case(name, solve, None, "of the load is carried", **limits)


def _press_case(stack: Stack, indenter: Indenter, finest: float, steps: int) -> CaseValues:
    """Press ever deeper; the depth reached, and the reason for stopping."""
    press = AxisymmetricPress(stack, indenter, finest=finest)
    refused, found, x = "", None, np.zeros(0)
    try:
        for share in np.linspace(0.0, _DEEPEST, steps + 1)[1:]:
            found = press.to_depth(float(share) * stack.levels[-1])
            x = press.unknowns
    except SolidError as error:
        refused = str(error)
    if found is None:
        raise SolidError(refused)
    solid = press.solid
    inside = solid.forces(x)
    free = np.setdiff1d(np.arange(solid.unknowns), _fixed_unknowns(solid.nodes))
    unbalanced = (inside + press.contact.forces(x)[: len(inside)])[free]
    base = 2 * np.flatnonzero(solid.nodes[:, 1] < 1e-12) + 1
    thickness_ratio = 1.0 - np.array([found.thinning(k) for k in range(len(stack.sheets))])
    least = float(np.linalg.det(solid.deformation_gradient(x)).min())
    volumes = np.abs(np.array(found.volume_ratios) - 1.0)
    return CaseValues(
        residual=float(np.abs(unbalanced).max() / found.force),
        invariant=max(abs(float(inside[base].sum()) / found.force - 1.0), float(volumes.max())),
        reached=f"{found.depth / stack.levels[-1]:.0%} deep, {found.force:.1f} N, layers left "
        f"{', '.join(f'{share:.1%}' for share in thickness_ratio)}, least J {least:.2f}",
        reason=refused,
    )
