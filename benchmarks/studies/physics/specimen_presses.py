"""Interpolated presses on specimens of other thickness and stiffness against presses solved in 3D.

Run by `python -m eitskin.benchmarks.studies.physics.specimen_presses`.

Prints, as Markdown, the errors of signals of the reference sensor, all its heights or the modulus
of its encapsulation times a factor, pressed at six places.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.design.sensor import SensorDesign
from eitskin.provenance import Provenance
from eitskin.simulator.layer.pressed_touches import TouchModel
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.materials import NeoHookean
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.scene.touch import Touch
from eitskin.simulator.simulator import Simulator

THICKER, STIFFER = (0.95, 1.05), (0.5, 0.7, 0.9, 1.1, 1.4, 2.0)
FORCES = (5.0, 10.0)
HEADINGS = (
    "specimen",
    "force",
    "rms error of signals",
    "largest, of a press's largest signal",
    "if nothing had changed, rms",
)
PLACES = tuple((x, y) for x in (0.015, 0.045, 0.075) for y in (0.015, 0.030))


def main() -> None:
    """Print a row for each specimen and force."""
    nominal, shared = SensorDesign.reference(), Mechanics()
    specimens = {"nominal": (nominal, shared)}
    for factor in THICKER:
        heights = (factor * nominal.thickness, factor * nominal.encapsulated_thickness)
        design = dataclasses.replace(
            nominal, thickness=heights[0], encapsulated_thickness=heights[1]
        )
        specimens[f"{factor:g} times as thick"] = design, shared
    law = shared.stack(nominal).sheets[-1].law
    for factor in STIFFER:
        encapsulation = NeoHookean(factor * law.shear_modulus)
        mechanics = dataclasses.replace(shared, encapsulation=encapsulation)
        specimens[f"{factor:g} times as stiff"] = nominal, mechanics
    print(" | ".join(("", *HEADINGS, "")).strip(), "|---" * len(HEADINGS) + "|", sep="\n")
    for name, (design, mechanics) in specimens.items():
        tabulated = dataclasses.replace(mechanics, solved_thickness=nominal.thickness)
        for force in FORCES:
            exact = signals(design, mechanics, "solved", force)
            found = signals(design, tabulated, "tabulated", force)
            unmoved = signals(nominal, shared, "tabulated", force)
            error = np.abs(found - exact).max(axis=1) / np.abs(exact).max(axis=1)
            rms, unchanged = (
                np.linalg.norm(each - exact) / np.linalg.norm(exact) for each in (found, unmoved)
            )
            print(
                f"| {name} | {force:g} N | {100 * rms:.2f} % | {100 * error.max():.1f} % "
                f"| {100 * unchanged:.1f} % |",
                flush=True,
            )
    print(f"\n{Provenance.now(0)}")


def signals(
    design: SensorDesign, mechanics: Mechanics, touch_model: TouchModel, force: float
) -> NDArray[np.float64]:
    """Relative changes by a press at each of the places, (places, measurements)."""
    sim = Simulator(design, "fast", mechanics=mechanics, touch_model=touch_model)
    flat = sim.measure(Scene()).impedance
    pressed = sim.measure_all([Scene(touches=(Touch(x, y, force),)) for x, y in PLACES])
    return np.asarray((pressed / flat - 1.0).real)


if __name__ == "__main__":
    main()
