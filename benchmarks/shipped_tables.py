"""Tables of presses and bends that ship with the package, solved anew.

Run by `EITSKIN_CACHE=FOLDER python -m eitskin.benchmarks.shipped_tables [--bends]`.

Solves the tables that neither the package nor `FOLDER` has, of the reference sensor and of its
neighbours, and prints how long they took and how large each file is. In `simulator/presses/library`
are presses by the 15 mm cylinder: corrections with neighbours in thickness and stiffness of the
encapsulation, those beside one straight side, and dents on all stacks that the shipped recipes
draw. In `simulator/bends/library` are bends by the default clamp, both faces held or the bottom,
with neighbours in span and offset too. With `--bends`, bends only.
"""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from eitskin.geometry.deformation.fixtures import Clamp
from eitskin.geometry.design.outline import Polygon
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.provenance import Provenance
from eitskin.simulator.bends import bend_store
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.materials import NeoHookean
from eitskin.simulator.mechanics.solved_files import folder
from eitskin.simulator.presses import correction_store, press_store
from eitskin.simulator.scene.indenters import Cylinder

_VARIED = 1.02  # values that need all next neighbours, relative to the nominal ones
_FARTHER = (0.5, 2.0)  # moduli of the encapsulation two steps away, relative to the nominal one
_SPREAD = (0.68, 1.47)  # those whose presses need all moduli up to three steps away


def main(only_bends: bool) -> None:
    """Solve the tables and print their cost."""
    print(Provenance.now(seed=0))
    reference, materials = SensorDesign.reference(), Mechanics()
    varied = replace(
        reference,
        thickness=_VARIED * reference.thickness,
        encapsulated_thickness=_VARIED * reference.encapsulated_thickness,
    )
    stiffer = replace(
        materials,
        solved_thickness=reference.thickness,
        encapsulation=NeoHookean(_VARIED * materials.encapsulation.shear_modulus),
        solved_ratio=materials.encapsulation.shear_modulus / materials.gel.shear_modulus,
    )
    clamp = Clamp()
    moved = Clamp(
        _VARIED * clamp.span,
        _VARIED * clamp.offset,
        solved_span=clamp.span,
        solved_offset=clamp.offset,
    )
    for name, design, mechanics, fixture in (
        ("held on both faces", reference, materials, clamp),
        ("held below", reference, materials, replace(clamp, faces="bottom")),
        ("neighbours in a clamp", varied, stiffer, moved),
    ):
        with _reported(name):
            bend_store.prepare([(design, fixture, mechanics)], _progress)
    if only_bends:
        return
    with _reported("reference"):
        press_store.press_table(reference, materials, Cylinder())
        correction_store.prepare(reference, materials, Cylinder(), _progress)
    with _reported("presses on neighbours"):
        spread = [
            (
                varied,
                replace(stiffer, encapsulation=NeoHookean(f * stiffer.encapsulation.shear_modulus)),
            )
            for f in _SPREAD
        ]
        press_store.prepare(spread, Cylinder(), _progress)
    square = Polygon(((0.0, 0.0), (0.1, 0.0), (0.1, 0.1), (0.0, 0.1)))
    with _reported("a straight side, for polygons"):
        polygon = replace(reference, outline=square, electrodes=uniform(square, 8))
        correction_store.prepare(polygon, materials, Cylinder(), _progress)
    with _reported("neighbours"):
        correction_store.prepare(varied, stiffer, Cylinder(), _progress)
    for factor in _FARTHER:
        around = NeoHookean(factor * materials.encapsulation.shear_modulus)
        with _reported(f"encapsulation {factor:g} times as stiff"):
            mechanics = replace(materials, encapsulation=around)
            correction_store.prepare(reference, mechanics, Cylinder(), _progress)


@contextmanager
def _reported(name: str) -> Iterator[None]:
    """Print the time of the tables solved within, and the sizes of their files."""
    start, before = time.perf_counter(), set(folder().glob("*.npz"))
    yield
    new = sorted(set(folder().glob("*.npz")) - before)
    print(f"{name}: {len(new)} tables, {time.perf_counter() - start:.0f} s")
    for path in new:
        print(f"  {path.name}: {1e-3 * path.stat().st_size:.0f} kB")


def _progress(done: int, total: int) -> None:
    print(f"  {done} of {total}", flush=True)


if __name__ == "__main__":
    main("--bends" in sys.argv[1:])
