"""Reference solutions of presses: the command that writes them.

Run by `python -m eitskin.benchmarks.reference.run --out FILE`; needs the extra `reference`.

Every case of `cases` is solved once by finite elements of NGSolve (`pressed_reference`) on the
whole sensor stack, and its displacement gradient is evaluated at the quadrature points of the
forward model at "fine". FILE is rewritten after each case, and cases that it holds are not solved
again. With `--fields FOLDER`, displacement and gradient at these points are kept too, NAME.npz with
arrays `points` (n, 3) [m], `displacement` (n, 3) [m] and `gradient` (n, 3, 3) of single precision.

FILE is a JSON object:

- `command`, `provenance`: how it was made; `provenance` names the version of NGSolve too.
- `solutions`: a list of objects with
  - `name`: of the case, unique;
  - `touches`: list of [x, y] [mm], each with `force` [N] and the same `indenter`, an object with
    `shape`, "cylinder" or "sphere", and `radius` [mm]; rough;
  - `support`, `angle` [deg], `thickness`, `ratio`, `substrate`: as in `Case`;
  - `depth`: of each indenter under the undeformed or bent top [mm];
  - `error`: estimated error of `changes` over the norm of `changes`, from refinement;
  - `unknowns`, `seconds`: of the solution;
  - `changes`: relative change of each of the 28 pair resistances, by `Protocol.pairwise(8)`; null
    where the sensor does not carry the press, with the reason in `refused`;
  - `bend_changes`: the same without the touches, of a sensor that is bent and pressed.
"""

import argparse
import json
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.reference.case import Case
from eitskin.benchmarks.reference.cases import cases
from eitskin.benchmarks.reference.pressed_reference import Numerics, ReferenceStack
from eitskin.extras import require_all
from eitskin.files import atomic_file
from eitskin.geometry.deformation.kinematics import Displaced
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.provenance import Provenance
from eitskin.simulator.electrical.resolution import Resolution
from eitskin.simulator.mechanics.load_stepping import SolidError
from eitskin.simulator.scene.indenters import Cylinder
from eitskin.simulator.simulator import Simulator

Array = NDArray[np.float64]
ERROR = 0.015
"""Estimated error of the changes over their norm, see docs/reference-solutions.md."""
COMMAND = "python -m eitskin.benchmarks.reference.run --out FILE"


class Gauge:
    """Forward model of one sensor that measures relative changes.

    Attributes:
        simulator: of the flat sensor.
        flat: resistances of the flat, untouched sensor [ohm].
    """

    def __init__(self, design: SensorDesign, resolution: Resolution = "fine") -> None:
        """Mesh the sensor and solve without touch."""
        self.simulator = Simulator(design, resolution)
        self.flat = self.simulator.protocol.measure(self.simulator.model.impedance()).real

    def changes(
        self, stack: ReferenceStack, keep: Callable[[Array, Array, Array], object] | None = None
    ) -> Array:
        """Relative change of each resistance; `keep` gets points, displacement and gradient."""

        def derivative(points: Array) -> Array:
            displacement, gradient = stack.displacement_and_gradient(points)
            if keep is not None:
                keep(points, displacement, gradient)
            return gradient

        frame = self.simulator.deformed(Displaced(np.zeros_like, derivative))
        changes: Array = frame.impedance.real / self.flat - 1.0
        return changes


def described(case: Case) -> dict[str, Any]:
    """Attributes of a case as they are written."""
    shape = "cylinder" if isinstance(case.indenter, Cylinder) else "sphere"
    return {
        "name": case.name,
        "touches": [list(touch) for touch in case.touches],
        "force": case.force,
        "indenter": {"shape": shape, "radius": round(1e3 * case.indenter.radius, 6)},
        "support": case.support,
        "angle": case.angle,
        "thickness": case.thickness,
        "ratio": case.ratio,
        "substrate": list(case.substrate) if case.support == "substrate" else None,
    }


def solved(
    case: Case, gauge: Gauge, numerics: Numerics | None = None, fields: Path | None = None
) -> dict[str, Any]:
    """Solution of a case as it is written."""
    start, kept = time.perf_counter(), []
    try:
        stack = ReferenceStack(case, numerics)
        stack.solve(lambda line: print(f"  {line}", flush=True))
    except SolidError as error:
        return described(case) | {"changes": None, "refused": str(error)}
    seconds = time.perf_counter() - start
    changes = gauge.changes(stack, lambda *arrays: kept.append(arrays))
    if fields is not None:
        names, widths = ("points", "displacement", "gradient"), ((3,), (3,), (3, 3))
        arrays: dict[str, Any] = {
            name: np.concatenate([part[k].reshape(-1, *width) for part in kept]).astype(np.float32)
            for k, (name, width) in enumerate(zip(names, widths, strict=True))
        }
        np.savez(fields / f"{case.name}.npz", **arrays)
    return (
        described(case)
        | {
            "depth": stack.depths.tolist(),
            "error": ERROR,
            "unknowns": stack.solid.unknowns,
            "seconds": round(seconds, 1),
            "changes": changes.tolist(),
        }
        | _untouched(case, gauge, numerics)
    )


def _untouched(case: Case, gauge: Gauge, numerics: Numerics | None) -> dict[str, Any]:
    """Changes by the bend alone of a case that is bent and pressed, solved on the same mesh."""
    if not (case.angle and case.touches):
        return {}
    stack = ReferenceStack(case, numerics)
    stack.bend(lambda line: print(f"  untouched, {line}", flush=True))
    return {"bend_changes": gauge.changes(stack).tolist()}


def write(path: Path, solutions: list[dict[str, Any]]) -> None:
    """Write all solutions to a file."""
    provenance = msgspec.to_builtins(Provenance.now(seed=0))
    provenance["packages"]["ngsolve"] = metadata.version("ngsolve")
    data = {"command": COMMAND, "provenance": provenance, "solutions": solutions}
    with atomic_file(path) as temporary:
        temporary.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    """Solve the cases."""
    require_all(reference="ngsolve netgen")
    options = argparse.ArgumentParser(description="Reference solutions of presses in 3D.")
    options.add_argument("--out", type=Path, required=True, help="JSON file; gone on with")
    options.add_argument("--fields", type=Path, help="folder for displacements and gradients")
    options.add_argument("--only", nargs="*", help="names of cases")
    chosen = options.parse_args()
    found = json.loads(chosen.out.read_text())["solutions"] if chosen.out.is_file() else []
    known = {one["name"] for one in found}
    gauges: dict[SensorDesign, Gauge] = {}
    for case in cases():
        if case.name in known or (chosen.only and case.name not in chosen.only):
            continue
        print(case.name, flush=True)
        design = case.design()
        if design not in gauges:
            gauges.clear()
            gauges[design] = Gauge(design)
        found.append(solved(case, gauges[design], fields=chosen.fields))
        write(chosen.out, found)


if __name__ == "__main__":
    main()
