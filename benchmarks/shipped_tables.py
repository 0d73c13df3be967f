"""Tables of presses and bends that ship with the package, solved again.

Run by `EITSKIN_CACHE=FOLDER python -m eitskin.benchmarks.shipped_tables [--bends]`.

Solves the tables that neither the package nor `FOLDER` has, of the reference sensor and of its
neighbours, and prints how long they took and how large each file is. Those in the package's
`simulator/deformation/library` are dents by the 15 mm cylinder on all stacks that the shipped
recipes draw, their corrections with neighbours in thickness and stiffness of the encapsulation,
those next to one straight side, presses on plates, and bends by the default clamp, both faces held
or the bottom, with neighbours in span and offset too. With `--bends`, bends only.
"""

import sys
import time
from collections.abc import Iterable
from dataclasses import replace

from eitskin.geometry import Clamp, Plates, Polygon, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.provenance import Provenance
from eitskin.simulator import Cylinder, Mechanics, SensorGrid
from eitskin.simulator.bends.bend_table import bend_problems
from eitskin.simulator.bends.pressed_plates import held_by_plates
from eitskin.simulator.deformation.press_table import press_problems
from eitskin.simulator.deformation.solution_store import Problem, cache_folder, prepare
from eitskin.simulator.deformation.tabled_corrections import correction_problems
from eitskin.simulator.mechanics.materials import NeoHookean

_VARIATION_FACTOR = 1.02  # values that need all next neighbours, relative to the nominal ones
_FARTHER = (0.5, 2.0)  # moduli of the encapsulation two steps away, relative to the nominal one
_SPREAD = (0.68, 1.47)  # those whose presses need all moduli up to three steps away


def main(only_bends: bool) -> None:
    """Solve the tables and print their cost."""
    print(Provenance.now(seed=0))
    reference, materials = SensorDesign.reference(), Mechanics()
    varied = replace(
        reference,
        thickness=_VARIATION_FACTOR * reference.thickness,
        encapsulated_thickness=_VARIATION_FACTOR * reference.encapsulated_thickness,
    )
    stiffer, clamp = _stiffen_encapsulation(materials, _VARIATION_FACTOR), Clamp()
    moved = Clamp(_VARIATION_FACTOR * clamp.span, _VARIATION_FACTOR * clamp.offset)
    grid = SensorGrid.from_nominal(reference, clamp, materials)
    below = replace(clamp, faces="bottom")
    _solve("bends held on both faces", bend_problems(reference, clamp, materials))
    _solve("bends held below", bend_problems(reference, below, materials))
    _solve("bends of neighbours", bend_problems(varied, moved, stiffer, grid))
    if only_bends:
        return
    press = Cylinder()
    square = Polygon(((0.0, 0.0), (0.1, 0.0), (0.1, 0.1), (0.0, 0.1)))
    polygon = replace(reference, outline=square, electrodes=uniform(square, 8))
    _solve("dents of the reference", press_problems(reference, materials, press))
    for factor in _SPREAD:
        dents = press_problems(varied, _stiffen_encapsulation(materials, factor), press, grid)
        _solve(f"dents of neighbours, {factor:g} times as stiff", dents)
    _solve("reference", correction_problems(reference, materials, press))
    _solve("a straight side, for polygons", correction_problems(polygon, materials, press))
    _solve("neighbours", correction_problems(varied, stiffer, press, grid))
    on_plates = replace(reference, support=Plates(clamp.span))
    held = held_by_plates(on_plates, clamp, materials, grid)
    _solve("presses on plates", [held.problem(press)] if held else [])
    for factor in _FARTHER:
        farther = correction_problems(reference, _stiffen_encapsulation(materials, factor), press)
        _solve(f"encapsulation {factor:g} times as stiff", farther)


def _stiffen_encapsulation(materials: Mechanics, factor: float) -> Mechanics:
    """Materials with an encapsulation `factor` times as stiff."""
    law = NeoHookean(factor * materials.encapsulation.shear_modulus)
    return replace(materials, encapsulation=law)


def _solve(name: str, problems: Iterable[Problem]) -> None:
    """Solve what is missing; print the time, and the sizes of the new files."""
    start, before = time.perf_counter(), set(cache_folder().glob("*.npz"))
    prepare(problems, lambda done, total: print(f"  {done} of {total}", flush=True))
    new = sorted(set(cache_folder().glob("*.npz")) - before)
    print(f"{name}: {len(new)} tables, {time.perf_counter() - start:.0f} s")
    for path in new:
        print(f"  {path.name}: {1e-3 * path.stat().st_size:.0f} kB")


if __name__ == "__main__":
    main("--bends" in sys.argv[1:])
