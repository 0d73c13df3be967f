"""Tables of presses that ship with the package, solved anew.

Run by `EITSKIN_CACHE=FOLDER python -m eitskin.benchmarks.studies.physics.shipped_tables`.

Solves what `FOLDER` lacks of the tables of the reference sensor and of its neighbours in thickness
and stiffness of the encapsulation, under the 15 mm cylinder, and prints how long each took and how
large its file is. The files belong in `simulator/presses/library`.
"""

import time
from dataclasses import replace

from eitskin.geometry.design.sensor import SensorDesign
from eitskin.provenance import Provenance
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.materials import NeoHookean
from eitskin.simulator.mechanics.solved_files import folder
from eitskin.simulator.presses import correction_store, press_store
from eitskin.simulator.scene.indenters import Cylinder

_VARIED = 1.02  # thickness and ratio of moduli that need all neighbours


def main() -> None:
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
    )
    sensors = (("reference", reference, materials), ("neighbours", varied, stiffer))
    for name, design, mechanics in sensors:
        start, before = time.perf_counter(), set(folder().glob("*.npz"))
        if design == reference:
            press_store.press_table(design, mechanics, Cylinder())
        correction_store.prepare(
            design, mechanics, Cylinder(), lambda done, total: print(f"  {done} of {total}")
        )
        new = sorted(set(folder().glob("*.npz")) - before)
        print(f"{name}: {len(new)} tables, {time.perf_counter() - start:.0f} s")
        for path in new:
            print(f"  {path.name}: {1e-3 * path.stat().st_size:.0f} kB")


if __name__ == "__main__":
    main()
