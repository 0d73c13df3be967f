"""Independent 3D reference solutions of presses, by finite elements of NGSolve.

Run by `python -m eitskin.benchmarks.pressed_reference --out FILE`; needs the extra `reference`.

Presses on flat sensors in `published/world_reference.json` are solved again on the whole stack:
prisms, nearly incompressible neo-Hookean solids at finite strain, and a contact that has the
displacement of the axisymmetric press relative to the indenter. FILE, of the same form, is
rewritten after each case, and cases that it holds are not solved again. Lengths are in mm, moduli
in kPa, hence forces in mN. docs/reference-solutions.md describes method, errors and file.
"""

import argparse
import json
import time
from importlib import metadata
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.reference_cases import PUBLISHED, ReferenceCase, cases
from eitskin.benchmarks.reference_solid import (
    Held,
    MixedSolid,
    Numerics,
    extruded,
    triangulated,
    within,
)
from eitskin.extras import require, require_all
from eitskin.files import atomic_file
from eitskin.geometry.deformation.kinematics import Displaced
from eitskin.geometry.design.sensor import Free, Plates, Substrate
from eitskin.provenance import Provenance
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.layer_stack import Stack
from eitskin.simulator.mechanics.load_stepping import SolidError
from eitskin.simulator.scene.indenters import Indenter
from eitskin.simulator.simulator import Simulator

Array = NDArray[np.float64]

COMMAND = "python -m eitskin.benchmarks.pressed_reference --out FILE"
_SAME, _INWARDS = 1e-6, 1e-6  # [mm]; shift of evaluated points into the gel [mm]
_LAYERS = (2, 1, 1, 1)  # prisms over substrate, encapsulation, gel and encapsulation
_MIN_LOAD_STEP = 0.02
_CELL, _STEPS = 1.0 / 60.0, 24  # finest of the axisymmetric press, over the radius; its steps
_KNOTS = 0.05  # of the contact profile [mm]


def contact_profile(stack: Stack, indenter: Indenter, force: float) -> tuple[float, Array, Array]:
    """Contact of the axisymmetric press at a force [N].

    Returns the undeformed radius where contact ends [mm], radii rising from 0 (n,) [mm], and there
    the displacement outwards, and upwards from the indenter's lowest point, (n, 2) [mm].
    """
    press = AxisymmetricPress(stack, indenter, finest=_CELL * indenter.rims[1])
    # Small steps, since a rough indenter sticks to newly touched points only after each.
    for part in (np.arange(1, _STEPS + 1) / _STEPS) ** 1.5:
        found = press.to_force(part * force)
    pressure = press.contact.nominal_pressure(press.unknowns).ravel()
    r = press.contact.points[..., 0].ravel()
    order = np.argsort(r)
    last = np.flatnonzero(pressure[order] > 0.0)[-1]
    top = found.displacement[:, -1].copy()
    top[:, 1] += found.depth
    return 1e3 * float(r[order][last : last + 2].mean()), 1e3 * found.r, 1e3 * top


class ReferenceStack:
    """Meshed sensor of one case; `solve` gives its equilibrium.

    Attributes:
        case: what is solved.
        solid: of the last order.
        depths: of the indenters' lowest points under the undeformed top [mm].
    """

    def __init__(self, case: ReferenceCase, numerics: Numerics | None = None) -> None:
        """Mesh the case."""
        self.case, self._numerics = case, numerics or Numerics()
        design, mechanics, support = case.design, case.mechanics, case.design.support
        self._gel = 1e3 * np.array([design.outline.length, design.outline.width, design.thickness])
        self._around = 0.5e3 * (design.encapsulated_thickness - design.thickness)
        self._touches = tuple((1e3 * touch.x, 1e3 * touch.y) for touch in case.scene.touches)
        first = case.scene.touches[0]
        self._force, stack = 1e3 * (first.force or 0.0), mechanics.stack(design)
        self._profile = contact_profile(stack, first.indenter, 1e-3 * self._force)
        self.depths: Array = np.zeros(len(self._touches))
        margin, (length, width, height) = 1e3 * mechanics.margin, self._gel.tolist()
        box = (-margin, length + margin, -margin, width + margin)
        breaks = [0.0, length]
        if isinstance(support, Plates):
            breaks += [1e3 * x for x in support.gap(design.outline)]
        lines = [((x, box[2]), (x, box[3])) for x in breaks]
        lines += [((box[0], y), (box[1], y)) for y in (0.0, width)]
        plan = triangulated(box, lines, self._touches, self._profile[0], self._numerics)
        levels = [-self._around, 0.0, height, height + self._around]
        if isinstance(support, Substrate):
            levels = [-self._around - 1e3 * support.thickness, *levels]
        heights = [levels[0]]
        for (low, high), count in zip(pairwise(levels), _LAYERS[-len(levels) + 1 :], strict=True):
            heights += np.linspace(low, high, count + 1)[1:].tolist()
        self._top, self._bottom = levels[-1], levels[0]
        self._mesh = extruded(*plan, heights, self._material, self._boundary)
        self.solid = self._solid(max(2, self._numerics.order - 1))

    def solve(self) -> None:
        """Equilibrium by steps of the load, then of full order; raises SolidError without one."""
        shapes = [self._shape(touch) for touch in self._touches]

        def held(t: float) -> list[Held]:
            contacts = enumerate(shapes)
            return [Held(f"contact {k}", t * shape, t * self._force) for k, shape in contacts]

        reached, step = 0.0, 0.5
        while reached < 1.0:
            t = min(1.0, reached + step)
            try:
                iterations = self.solid.settle(held(t))
            except SolidError:
                step = 0.5 * (t - reached)
                if step < _MIN_LOAD_STEP:
                    raise
                continue
            reached, step = t, (1.5 if iterations < 7 else 1.0) * step
        lower, self.solid = self.solid, self._solid(self._numerics.order)
        self.solid.start(lower)
        self.solid.settle(held(1.0))
        self.depths = self.solid.steps

    def gradient(self, points: Array) -> Array:
        """Displacement gradient (..., 3, 3) at points (..., 3) of the gel [m]."""
        x = np.clip(1e3 * points.reshape(-1, 3), _INWARDS, self._gel - _INWARDS)
        slope: Array = require("ngsolve", "reference").Grad(self.solid.state.components[0])(
            self.solid.mesh(*x.T)
        )
        return slope.reshape(*points.shape, 3)

    def _solid(self, order: int) -> MixedSolid:
        """Solid of displacements of an order on the mesh, at rest."""
        mechanics, support = self.case.mechanics, self.case.design.support
        moduli = {
            "gel": 1e-3 * mechanics.gel.shear_modulus,
            "encapsulation": 1e-3 * mechanics.encapsulation.shear_modulus,
        }
        if isinstance(support, Substrate):
            moduli["substrate"] = 1e-3 * support.shear_modulus
        fixed = {"base": "xyz"} | ({"side": "xyz"} if isinstance(support, Free) else {})
        return MixedSolid(self._mesh, moduli, order, fixed, mechanics.bulk_ratio)

    def _material(self, centre: Array) -> str:
        if centre[2] < -self._around:
            return "substrate"
        in_gel = np.all((centre > 0.0) & (centre < self._gel))
        return "gel" if in_gel else "encapsulation"

    def _boundary(self, centre: Array) -> str:
        if centre[2] > self._top - _SAME:
            for number, touch in enumerate(self._touches):
                if within(centre[:2], touch, self._profile[0]):
                    return f"contact {number}"
            return "top"
        if centre[2] > self._bottom + _SAME:
            return "side"
        support, x = self.case.design.support, 1e-3 * float(centre[0])
        if isinstance(support, Plates):
            low, high = support.gap(self.case.design.outline)
            return "under" if low < x < high else "base"
        return "under" if isinstance(support, Free) else "base"

    def _shape(self, touch: tuple[float, float]) -> Any:
        """Displacement of a contact when the indenter's lowest point is on the top at rest."""
        ng, (radius, radii, displacement) = require("ngsolve", "reference"), self._profile
        along, across = ng.x - touch[0], ng.y - touch[1]
        r = ng.sqrt(along**2 + across**2 + 1e-12)
        knots = np.arange(0.0, 1.1 * radius, _KNOTS)
        outwards, upwards = (
            ng.BSpline(2, [0.0, *knots], np.interp(knots, radii, values).tolist())(r)
            for values in displacement.T
        )
        return ng.CF((outwards * along / r, outwards * across / r, upwards))


def solution(
    case: ReferenceCase, described: dict[str, Any], simulator: Simulator
) -> dict[str, Any]:
    """Solution of a case as it is written, with changes by the forward model of a simulator."""
    start = time.perf_counter()
    try:
        stack = ReferenceStack(case)
        stack.solve()
    except SolidError as error:
        return described | {"changes": None, "refused": str(error)}
    seconds = time.perf_counter() - start
    flat = simulator.protocol.measure(simulator.model.impedance()).real
    pressed = simulator.deformed(Displaced(np.zeros_like, stack.gradient)).impedance.real
    return described | {
        "depth": stack.depths.tolist(),
        "unknowns": stack.solid.unknowns,
        "seconds": round(seconds, 1),
        "changes": (pressed / flat - 1.0).tolist(),
    }


def main() -> None:
    """Solve the cases."""
    require_all(reference="ngsolve netgen")
    options = argparse.ArgumentParser(description="Reference solutions of presses in 3D.")
    options.add_argument("--out", type=Path, required=True, help="JSON file; gone on with")
    options.add_argument("--only", nargs="*", help="names of cases")
    chosen = options.parse_args()
    found = json.loads(chosen.out.read_text())["solutions"] if chosen.out.is_file() else []
    known = {one["name"] for one in found}
    published = {one["name"]: one for one in json.loads(PUBLISHED.read_text())["solutions"]}
    provenance = msgspec.to_builtins(Provenance.now(seed=0))
    provenance["packages"]["ngsolve"] = metadata.version("ngsolve")
    for case in cases():
        flat = case.kind in ("press", "supported press")
        if not flat or case.name in known or case.name not in (chosen.only or published):
            continue
        print(case.name, flush=True)
        found.append(solution(case, published[case.name], Simulator(case.design, "fine")))
        data = {"command": COMMAND, "provenance": provenance, "solutions": found}
        with atomic_file(chosen.out) as temporary:
            temporary.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
