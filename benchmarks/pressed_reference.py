"""Independent 3D reference solutions of presses, by finite elements of NGSolve.

Run by `python -m eitskin.benchmarks.pressed_reference --out FILE`; needs the extra `reference`.
The sensor is bent by its plates, then pressed by the indenters' own shapes in unilateral contact;
nothing is taken from the product but laws, sizes and shapes. FILE has the form of
`published/world_reference.json` and is rewritten after each case. Units: mm, kPa, mN.
"""

import argparse
import json
import math
import time
from importlib import metadata
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.reference_solid import (
    MixedSolid,
    Numerics,
    RoughContact,
    extrude,
    is_within,
    triangulate_box,
)
from eitskin.benchmarks.world import PUBLISHED_FILE, UNILATERAL, Gauge, ReferenceCase, cases
from eitskin.extras import require, require_all
from eitskin.files import atomic_file
from eitskin.geometry import Clamp, Free, Plates, Substrate
from eitskin.geometry.deformation.kinematics import Displaced
from eitskin.provenance import Provenance
from eitskin.simulator.mechanics.load_stepping import SolidError
from eitskin.simulator.scene.scene import Touch

Array = NDArray[np.float64]

_COMMAND = "python -m eitskin.benchmarks.pressed_reference --out FILE"
_SAME, _INWARDS = 1e-6, 1e-6  # [mm]; shift of evaluated points into the gel [mm]
_LAYERS = (2, 1, 1, 1)  # prisms over substrate, encapsulation, gel and encapsulation
_STIFFNESS = 3000.0  # of a contact's springs, over the modulus of the cover over the radius
_ZONE = 1.25  # radius within which points may touch, over that of the indenter
_BEND_STEP_DEG = 10.0


class ReferenceStack:
    """Meshed part of a sensor that symmetry leaves of one case; `solve` gives its equilibrium.

    Attributes:
        bent: solid of the last order, bent and not pressed; None on a flat sensor.
        solid: solid of the last order, bent and pressed.
        depths: depths of the indenters' lowest points under the flat or bent top [mm].
    """

    bent: MixedSolid | None = None

    def __init__(self, case: ReferenceCase, numerics: Numerics | None = None) -> None:
        """Mesh the case."""
        self._case, self._numerics = case, numerics or Numerics()
        design, mechanics, support = case.design, case.mechanics, case.design.support
        self._gel = 1e3 * np.array([design.outline.length, design.outline.width, design.thickness])
        self._around = 0.5e3 * (design.encapsulated_thickness - design.thickness)
        places = 1e3 * np.array([[touch.x, touch.y] for touch in case.scene.touches])
        self._is_halved = np.array([_is_mirrored(places, axis, self._gel) for axis in (0, 1)])
        self._places = np.where(self._is_halved, np.minimum(places, self._gel[:2] - places), places)
        self._touches: list[tuple[Array, Touch]] = []
        for place, touch in zip(self._places, case.scene.touches, strict=True):
            if not any(np.allclose(place, kept) for kept, _ in self._touches):
                self._touches.append((place, touch))
        self._radius = 1e3 * max(touch.indenter.rims[1] for touch in case.scene.touches)
        self._mesh = self._extrude(1e3 * mechanics.margin, support)
        self.depths = np.zeros(len(places))

    def solve(self) -> None:
        """Bend, then press by steps of the load, then at full order; may raise SolidError."""
        steps, bent = self._numerics.steps, self._bend()
        contacts = self._contacts(bent)
        pressed = self._load_further(bent, self._numerics.path, contacts)
        for part in (np.arange(1, steps + 1) / steps) ** 1.5:
            for contact, (place, touch) in zip(contacts, self._touches, strict=True):
                share = 0.5 ** np.sum(self._is_halved & np.isclose(place, 0.5 * self._gel[:2]))
                contact.force = float(part * share) * 1e3 * (touch.force or 0.0)
            pressed.press()
        self.solid = self._raise(pressed, contacts)
        kept = np.array([place for place, _ in self._touches])
        own = [np.linalg.norm(kept - place, axis=1).argmin() for place in self._places]
        self.depths = np.array([contacts[k].step.Get() for k in own])
        if self._case.scene.bend.angle_deg:
            self.bent = self._raise(bent, [])

    def gradient(self, solid: MixedSolid, points: Array) -> Array:
        """Displacement gradient (..., 3, 3) of a solid at points (..., 3) of the gel [m]."""
        x, signs = 1e3 * points.reshape(-1, 3), np.ones((points.size // 3, 3))
        beyond = self._is_halved & (x[:, :2] > 0.5 * self._gel[:2])
        x[:, :2] = np.where(beyond, self._gel[:2] - x[:, :2], x[:, :2])
        signs[:, :2] -= 2.0 * beyond
        end = np.append(np.where(self._is_halved, 0.5, 1.0), 1.0) * self._gel
        x = np.clip(x, _INWARDS, end - _INWARDS)
        slope = require("ngsolve", "reference").Grad(solid.displacement)(solid.mesh(*x.T))
        mirrored = signs[:, :, None] * slope.reshape(-1, 3, 3) * signs[:, None, :]
        return np.asarray(mirrored.reshape(*points.shape, 3))

    def _extrude(self, margin: float, support: object) -> Any:
        """Mesh of prisms of the part that is solved."""
        length, width, height = self._gel.tolist()
        ends = np.where(self._is_halved, 0.5 * self._gel[:2], self._gel[:2] + margin)
        self._ends = np.where(self._is_halved, ends, np.inf)
        box = (-margin, float(ends[0]), -margin, float(ends[1]))
        breaks = [0.0, length]
        if isinstance(support, Plates):
            breaks += [1e3 * x for x in support.gap(self._case.design.outline)]
        lines = [((x, box[2]), (x, box[3])) for x in breaks if x < box[1]]
        lines += [((box[0], y), (box[1], y)) for y in (0.0, width) if y < box[3]]
        centres = [place for place, _ in self._touches]
        plan = triangulate_box(box, lines, centres, self._radius, self._numerics)
        levels = [-self._around, 0.0, height, height + self._around]
        if isinstance(support, Substrate):
            levels = [levels[0] - 1e3 * support.thickness, *levels]
        heights = levels[:1]
        for (low, high), count in zip(pairwise(levels), _LAYERS[-len(levels) + 1 :], strict=True):
            heights += np.linspace(low, high, count + 1)[1:].tolist()
        self._top, self._bottom = levels[-1], levels[0]
        return extrude(*plan, heights, self._material, self._boundary)

    def _bend(self) -> MixedSolid:
        """Sensor that its plates have turned; flat and at rest without an angle."""
        ng = require("ngsolve", "reference")
        solid, angle = self._solid(self._numerics.path), self._case.scene.bend.angle_deg
        middle, clamp = (0.5 * self._gel).tolist(), Clamp()
        axis = ng.CF((middle[0], 0.0, middle[2] - 1e3 * clamp.offset))
        # Rigid on the plates; between them the turn rises with x.
        along = (ng.x - axis[0]) / (0.5e3 * clamp.span)
        along = ng.IfPos(along - 1.0, 1.0, ng.IfPos(along + 1.0, along, -1.0))
        count = math.ceil(abs(angle) / _BEND_STEP_DEG)
        X = ng.CF((ng.x, ng.y, ng.z))

        def rotation(start: Any, degrees: float) -> Any:
            turn = math.radians(0.5 * degrees) * along
            cos, sin = ng.cos(turn), ng.sin(turn)
            R = ng.CF((cos, 0, sin, 0, 1, 0, -sin, 0, cos), dims=(3, 3))
            return R * (start - axis) + axis - X

        for k in range(count):
            before, stress = (self._copy(each) for each in solid.state.components)
            plate = rotation(X, angle * (k + 1) / count)
            solid.start(rotation(X + before, angle / count), stress, {"plate": plate})
            solid.press()
        return solid

    def _copy(self, field: Any) -> Any:
        """Copy of a grid function."""
        copied = require("ngsolve", "reference").GridFunction(field.space)
        copied.vec.data = field.vec
        return copied

    def _contacts(self, bent: MixedSolid) -> list[RoughContact]:
        """Indenters on the bent top, each along its normal."""
        ng, contacts = require("ngsolve", "reference"), []
        modulus = 1e-3 * self._case.mechanics.encapsulation.shear_modulus
        for number, (place, touch) in enumerate(self._touches):
            at = np.append(place, self._top)
            inside = bent.mesh(*(at - _INWARDS * np.array([*self._is_halved, 1.0])))
            F = np.eye(3) + np.array(ng.Grad(bent.displacement)(inside)).reshape(3, 3)
            along, normal = F[:, 0], np.cross(F[:, 0], F[:, 1])
            along, normal = along / np.linalg.norm(along), normal / np.linalg.norm(normal)
            contacts.append(
                RoughContact(
                    self._mesh,
                    f"contact {number}",
                    touch.indenter,
                    _STIFFNESS * modulus / self._radius,
                    at + np.array(bent.displacement(inside)),
                    np.array([along, np.cross(normal, along), normal]),
                    bent.displacement,
                )
            )
        return contacts

    def _raise(self, solid: MixedSolid, contacts: list[RoughContact]) -> MixedSolid:
        """Equilibrium at full order, from that of the path, order by order."""
        for order in range(self._numerics.path + 1, self._numerics.order + 1):
            solid = self._load_further(solid, order, contacts)
            solid.press()
        return solid

    def _load_further(
        self, before: MixedSolid, order: int, contacts: list[RoughContact]
    ) -> MixedSolid:
        """Solid of an order with contacts that starts from another."""
        solid, u = self._solid(order, contacts), before.displacement
        solid.start(u, before.state.components[1], {"plate": u} if self._is_bent else {})
        return solid

    @property
    def _is_bent(self) -> bool:
        return bool(self._case.scene.bend.angle_deg)

    def _solid(self, order: int, contacts: list[RoughContact] | None = None) -> MixedSolid:
        """Solid of displacements of an order on the mesh, at rest."""
        mechanics, support = self._case.mechanics, self._case.design.support
        laws = {"gel": mechanics.gel, "encapsulation": mechanics.encapsulation}
        moduli = {name: 1e-3 * law.shear_modulus for name, law in laws.items()}
        if isinstance(support, Substrate):
            moduli["substrate"] = 1e-3 * support.shear_modulus
        fixed = {"base": "xyz", "plate": "xyz", "middle 0": "x", "middle 1": "y"}
        if isinstance(support, Free):
            fixed["side"] = "xyz"
        fixed = {name: axes for name, axes in fixed.items() if name in self._mesh.GetBoundaries()}
        ratio = mechanics.bulk_ratio
        return MixedSolid(self._mesh, moduli, order, fixed, contacts or [], ratio)

    def _material(self, centre: Array) -> str:
        if np.all((centre > 0.0) & (centre < self._gel)):
            return "gel"
        return "substrate" if centre[2] < -self._around else "encapsulation"

    def _boundary(self, centre: Array) -> str:
        for axis in np.flatnonzero(centre[:2] > self._ends - _SAME):
            return f"middle {axis}"
        if centre[2] > self._top - _SAME:
            for number, (place, _) in enumerate(self._touches):
                if is_within(centre[:2], place, _ZONE * self._radius):
                    return f"contact {number}"
            return "top"
        if centre[2] > self._bottom + _SAME:
            return "side"
        support, x = self._case.design.support, 1e-3 * float(centre[0])
        if isinstance(support, Plates):
            low, high = support.gap(self._case.design.outline)
            return "under" if low < x < high else "plate"
        return "under" if isinstance(support, Free) else "base"


def _is_mirrored(places: Array, axis: int, size: Array) -> bool:
    """Whether places (n, 2) are mirrored about the middle along an axis."""
    mirrored = places.copy()
    mirrored[:, axis] = size[axis] - mirrored[:, axis]
    first, second = ({tuple(p) for p in each.round(6).tolist()} for each in (places, mirrored))
    return first == second


def solution(case: ReferenceCase, numerics: Numerics | None = None) -> dict[str, Any]:
    """Solution of a case as it is written, with changes by the finest forward model.

    Raises SolidError where the sensor does not carry the press.
    """
    start, gauge = time.perf_counter(), Gauge(case.design, "fine")
    stack = ReferenceStack(case, numerics)
    stack.solve()
    seconds = time.perf_counter() - start

    def changes(solid: MixedSolid) -> list[float]:
        field = Displaced(np.zeros_like, lambda points: stack.gradient(solid, points))
        return list(gauge.changes(field))

    found = {
        "contact": UNILATERAL,
        "depth": stack.depths.tolist(),
        "unknowns": stack.solid.unknowns,
        "seconds": round(seconds, 1),
        "changes": changes(stack.solid),
    }
    return found | ({"bend_changes": changes(stack.bent)} if stack.bent else {})


def main() -> None:
    """Solve the cases."""
    require_all(reference="ngsolve netgen")
    options = argparse.ArgumentParser(description="Reference solutions of presses in 3D.")
    options.add_argument("--out", type=Path, required=True, help="JSON file; gone on with")
    options.add_argument("--only", nargs="*", help="names of cases, in this order")
    chosen = options.parse_args()
    written = json.loads((chosen.out if chosen.out.is_file() else PUBLISHED_FILE).read_text())
    earlier = written.get("earlier") or {key: written[key] for key in ("command", "provenance")}
    provenance = msgspec.to_builtins(Provenance.now(seed=0))
    provenance["packages"]["ngsolve"] = metadata.version("ngsolve")
    data = {"command": _COMMAND, "provenance": provenance, "earlier": earlier}
    solutions = {one["name"]: one for one in written["solutions"]}
    known = {case.name: case for case in cases() if case.scene.touches}
    for name in chosen.only or known:
        if solutions[name].get("contact") == UNILATERAL:
            continue
        try:
            solutions[name] |= solution(known[name])
        except SolidError as error:
            print(f"{name}: {error}", flush=True)
            continue
        print(name, solutions[name]["depth"], solutions[name]["seconds"], flush=True)
        with atomic_file(chosen.out) as temporary:
            text = json.dumps(data | {"solutions": list(solutions.values())}, indent=1)
            temporary.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
