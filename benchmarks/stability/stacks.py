"""Cases of presses on whole stacks: supports, stiffness, incompressibility and thickness.

Always true: the support carries the force of the indenter, to 3 % by the quadrature of the dent on
coarse cells, and the gel keeps its volume.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from eitskin.benchmarks.stability.case import Case, CaseValues
from eitskin.geometry.deformation.fixtures import Bend, Clamp
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.design.sensor import Free, Plates, Rigid, SensorDesign, Substrate, Support
from eitskin.simulator.bends import bend_table
from eitskin.simulator.deformation.contact import ContactFrame, DentField
from eitskin.simulator.deformation.finite_stack import FiniteStack
from eitskin.simulator.deformation.stack_mesh import Contact, Fineness, stack_mesh
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress, Indentation
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.materials import NeoHookean
from eitskin.simulator.scene.indenters import Cylinder

FAMILY = "whole stacks"
_OUTLINE = Rectangle(0.090, 0.050)
_PLACE = (0.040, 0.022)
_GEL = 5.0 / 12.0  # of the thickness of the stack
_DEPTH, _STEP, _CELL = 0.15, 0.02, 1.0 / 12.0  # over the thickness; over the radius
_ONE_LAYER = Fineness(ends=0.0, sides=0.0, layers=1)


def stacks(quick: bool) -> Iterator[Case]:
    """Cases of a rough cylinder of 15 mm, or as thick as a thin stack, on 90 x 50 mm."""
    supports: dict[str, tuple[Support, float]] = {
        "rigid": (Rigid(), _DEPTH),
        "plates, shallow": (Plates(), 0.05),
        "plates, deep": (Plates(), 0.2),
        "substrate of 1 kPa": (Substrate(0.01, 1e3), _DEPTH),
        "substrate of 1 MPa": (Substrate(0.01, 1e6), _DEPTH),
        "free, shallow": (Free(), 0.02),
        "free, deep": (Free(), 0.1),
    }
    for name, (support, depth) in supports.items():
        if not quick or name == "rigid":
            yield _case(name, _design(0.012, support), Mechanics(), depth=depth)
    if quick:
        return
    for angle in (-20.0, 60.0):
        name = f"plates bent by {angle:g} deg"
        yield _case(name, _design(0.012, Plates()), Mechanics(), depth=0.05, angle=angle)
    for nu in (0.4999, 0.49999):
        ratio = 2.0 * (1.0 + nu) / (3.0 * (1.0 - 2.0 * nu))
        yield _case(f"nu = {nu:g}", _design(0.012), Mechanics(bulk_ratio=ratio))
    for factor in (0.01, 100.0):
        around = NeoHookean(factor * Mechanics().gel.shear_modulus)
        yield _case(f"casing of {factor:g} mu", _design(0.012), Mechanics(encapsulation=around))
    for thickness in (0.0005, 0.002, 0.030):
        yield _case(f"{1e3 * thickness:g} mm thick", _design(thickness), Mechanics())
    yield _case("gel thinned by 40 %", _design(0.012), Mechanics(), thinning=0.4)


def _design(thickness: float, support: Support | None = None) -> SensorDesign:
    """Rectangular sensor whose stack has a thickness [m]."""
    design = SensorDesign(
        _OUTLINE,
        _GEL * thickness,
        uniform(_OUTLINE, 8),
        encapsulated_thickness=thickness,
    )
    return replace(design, support=support or Rigid())


def _case(
    name: str,
    design: SensorDesign,
    mechanics: Mechanics,
    depth: float = _DEPTH,
    thinning: float | None = None,
    angle: float = 0.0,
) -> Case:
    solve = partial(_pressed, design, mechanics, depth, thinning, angle)
    return Case(FAMILY, name, solve, None, "", invariant_limit=0.05)


def _pressed(
    design: SensorDesign,
    mechanics: Mechanics,
    depth: float,
    thinning: float | None,
    angle: float,
) -> CaseValues:
    """Press on the whole stack, to a depth over the thickness or until the gel is thinned.

    The indenter presses along the normal of a stack that is bent by an angle [deg].
    """
    stack = mechanics.stack(design)
    punch = Cylinder(min(0.0075, stack.levels[-1]))
    dent = _dent(AxisymmetricPress(stack, punch, _CELL * punch.radius), depth, thinning)
    contacts = [Contact(*_PLACE, punch.radius)]
    body = stack_mesh(_OUTLINE, stack, mechanics, design.support, contacts, _ONE_LAYER)
    bent, frame, normal = None, None, np.array([0.0, 0.0, 1.0])
    if angle:
        bent = bend_table.equilibrium(design, Clamp(), mechanics, Bend(angle))
        frame = ContactFrame.at(bent, *_PLACE, stack.levels[-1] - stack.levels[stack.gel])
        normal = frame.normal
    solved = FiniteStack(body, bent=bent)
    found = solved.correction([DentField(*_PLACE, punch, dent, frame)])
    solid = solved.solid
    carried = float(solved.reaction(found) @ normal)
    J, weights = solid.volume_ratio(found.unknowns), solid.weights
    gel = body.gel_cells
    volume = float((J[gel] * weights[gel]).sum() / weights[gel].sum())
    return CaseValues(
        invariant=max(abs(carried / dent.force - 1.0), abs(volume - 1.0)),
        reached=f"{1e3 * dent.depth:.2f} mm deep, {1e3 * found.sunk[0]:.2g} mm deeper than without "
        f"sides, {dent.force:.2g} N, J {J[gel].min():.2f} to {J[gel].max():.2f}",
    )


def _dent(press: AxisymmetricPress, depth: float, thinning: float | None) -> Indentation:
    thickness, gel = press.stack.levels[-1], press.stack.gel
    if thinning is None:
        return press.to_depth(depth * thickness)
    return next(
        found
        for part in np.arange(_STEP, 1.0, _STEP)
        if (found := press.to_depth(part * thickness)).thinning(gel) >= thinning
    )
