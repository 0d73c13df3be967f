"""Cases of nearly incompressible layers, and of presses to their limits.

Always true: the base pushes back with the force on the indenter, and every layer keeps its
volume. The naive twin of the mixed elements has linear displacements on triangles alone.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any, Self, cast

import numpy as np
import skfem
from numpy.typing import NDArray
from scipy.sparse import csc_array
from skfem.helpers import ddot, div, sym_grad

from eitskin.benchmarks.stability.case import Case, CaseValues
from eitskin.benchmarks.stability.closed_forms import punched_layer
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.grading import Grading, graded_lines
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.layer_stack import Mechanics, Sheet, Stack
from eitskin.simulator.mechanics.load_stepping import ForceTerm, Load, SolidError, newton
from eitskin.simulator.mechanics.materials import NeoHookean
from eitskin.simulator.mechanics.mixed_solid import STIFFEST, Solid
from eitskin.simulator.scene.indenters import Cylinder, Indenter, Sphere

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_RADIUS, _THICKNESS, _REACH = 0.6, 1.0, 6.0  # of the punch and the layer, in any unit
_DEPTH = 1e-6  # so small that strains are linear
_LAST = 0.9  # depth, of the thickness


class Counted(ForceTerm):
    """Solid that counts its linearisations, one per iteration, and keeps its last state."""

    def __init__(self, solid: Solid) -> None:
        """Start counting."""
        self._solid = solid
        self.iterations = 0
        self.x: Array = np.zeros(0)

    def linearise(self, x: Array) -> tuple[Array, csc_array]:
        """Linearise the solid and count it."""
        self.iterations += 1
        return self._solid.linearise(x)

    def advanced(self, x: Array) -> Self:
        """This solid at the state x."""
        self.x = x
        return self

    @property
    def multipliers(self) -> int:
        """Number of pressures."""
        return self._solid.multipliers

    def forces(self, x: Array) -> Array:
        """Forces of the solid."""
        return self._solid.forces(x)

    def admissible(self, x: Array) -> bool:
        """Whether no cell is inverted."""
        return self._solid.admissible(x)

    def __getattr__(self, name: str) -> Any:
        """Any other attribute of the solid."""
        return getattr(self._solid, name)


def incompressible(quick: bool) -> Iterator[Case]:
    """Cases of a punch on a layer, from compressible to nearly incompressible."""
    for nu in (0.3, 0.499, 0.49999) if quick else (0.3, 0.4, 0.49, 0.499, 0.4999, 0.49999):
        ratio = 2.0 * (1.0 + nu) / (3.0 * (1.0 - 2.0 * nu))
        solve = partial(_punched, ratio)
        yield Case("incompressible", f"nu = {nu:g}", solve, error_limit=1e-2)
    for ratio in (1e6, STIFFEST):
        solve = partial(_punched, ratio)
        yield Case("incompressible", f"bulk modulus {ratio:g} mu", solve, error_limit=1e-2)
    for ratio in (1e9, 0.0, float("nan")):
        solve = partial(_punched, ratio)
        yield Case(
            "incompressible", f"bulk modulus {ratio:g} mu", solve, "refused", "bulk_ratio must"
        )


def _punched(ratio: float) -> CaseValues:
    """Small indentation of a bonded layer by a flat smooth punch."""
    sizes = Grading(4e-3, 0.2, 0.4)
    r = graded_lines(_REACH, (_RADIUS,), (), sizes)
    z = graded_lines(_THICKNESS, (_THICKNESS,), (), sizes)
    solid = Solid(skfem.MeshQuad.init_tensor(r, z), [NeoHookean(1.0)], None, "axisymmetric", ratio)
    held, values = _punch(solid.nodes)
    counted, start = Counted(solid), np.zeros(solid.unknowns)
    x = newton([counted], start, Load(held, values, start))
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
        naive=_linear_triangles(r, z, ratio) / exact - 1.0,
        iterations=counted.iterations,
    )


def _held(nodes: Array) -> Indices:
    """Unknowns fixed by the bonded base, the smooth axis and the wall around."""
    r, z = nodes.T
    sides = 2 * np.flatnonzero((r < 1e-12) | (r > r.max() - 1e-9))
    base = np.flatnonzero(z < 1e-12)
    return np.union1d(sides, np.concatenate([2 * base, 2 * base + 1]))


def _punch(nodes: Array) -> tuple[Indices, Array]:
    """Fixed unknowns, those under the punch last, and their values."""
    r, z = nodes.T
    held = _held(nodes)
    under = 2 * np.flatnonzero((z > _THICKNESS - 1e-9) & (r < _RADIUS + 1e-9)) + 1
    values = np.concatenate([np.zeros(len(held)), np.full(len(under), -_DEPTH)])
    return np.concatenate([held, under]), values


def _linear_triangles(r: Array, z: Array, ratio: float) -> float:
    """Force on the same punch by linear displacements on triangles, at small strain."""
    mesh = skfem.MeshTri.init_tensor(r, z)
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTriP1()), intorder=3)
    bulk = ratio - 2.0 / 3.0  # Lame's lambda for mu = 1

    def stiffness(u: Any, v: Any, w: Any) -> Any:
        hoop_u, hoop_v = u[0] / w.x[0], v[0] / w.x[0]
        volume = bulk * (div(u) + hoop_u) * (div(v) + hoop_v)
        shape = ddot(sym_grad(u), sym_grad(v)) + hoop_u * hoop_v
        return 2.0 * np.pi * w.x[0] * (volume + 2.0 * shape)

    K = skfem.BilinearForm(stiffness).assemble(basis)
    held, values = _punch(mesh.p.T)
    u = np.zeros(basis.N)
    u[held] = values
    u = skfem.solve(*skfem.condense(K, x=u, D=held))
    return float(-(K @ u)[held[values < 0.0]].sum())


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
        solve = partial(_pressed, *bodies[name], finest, steps)
        # Layers change volume by mean pressure over bulk modulus, 1e4 mu.
        limits = {"residual_limit": 1e-6, "invariant_limit": 1e-4}
        yield Case("presses", name, solve, None, "of the load only", **limits)


def _pressed(stack: Stack, indenter: Indenter, finest: float, steps: int) -> CaseValues:
    """Press ever deeper; the depth reached, and the reason for stopping."""
    press = AxisymmetricPress(stack, indenter, finest=finest)
    counted = Counted(press.solid)
    press.solid = cast("Solid", counted)
    refused, found, x = "", None, counted.x
    try:
        for share in np.linspace(0.0, _LAST, steps + 1)[1:]:
            found = press.to_depth(float(share) * stack.levels[-1])
            x = counted.x
    except SolidError as error:
        refused = str(error)
    if found is None:
        raise SolidError(refused)
    solid = press.solid
    inside = solid.forces(x)
    free = np.setdiff1d(np.arange(solid.unknowns), _held(solid.nodes))
    unbalanced = (inside + press.contact.forces(x)[: len(inside)])[free]
    base = 2 * np.flatnonzero(solid.nodes[:, 1] < 1e-12) + 1
    left = 1.0 - np.array([found.thinning(k) for k in range(len(stack.sheets))])
    least = float(np.linalg.det(solid.deformation_gradient(x)).min())
    volumes = np.abs(np.array(found.volume_ratios) - 1.0)
    return CaseValues(
        residual=float(np.abs(unbalanced).max() / found.force),
        invariant=max(abs(float(inside[base].sum()) / found.force - 1.0), float(volumes.max())),
        iterations=counted.iterations,
        reached=f"{found.depth / stack.levels[-1]:.0%} deep, {found.force:.1f} N, layers left "
        f"{', '.join(f'{share:.1%}' for share in left)}, least J {least:.2f}",
        refused=refused,
    )
