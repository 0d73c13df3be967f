"""Interpolated presses on sensors of another thickness against presses solved in 3D.

Run by `python -m eitskin.benchmarks.studies.physics.thickness`.

Prints, as Markdown, the errors of signals of the reference sensor, all its heights times a factor,
pressed at six places.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.design.sensor import SensorDesign
from eitskin.provenance import Provenance
from eitskin.simulator.layer.pressed_touches import TouchModel
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.scene.touch import Touch
from eitskin.simulator.simulator import Simulator

FACTORS = (0.95, 1.0, 1.05)
FORCES = (5.0, 10.0)
HEADINGS = (
    "thickness",
    "force",
    "rms error of signals",
    "largest, of a press's largest signal",
    "without any change of thickness, rms",
)
PLACES = tuple((x, y) for x in (0.015, 0.045, 0.075) for y in (0.015, 0.030))


def main() -> None:
    """Print a row for each thickness and force."""
    nominal = SensorDesign.reference()
    shared = Mechanics(solved_thickness=nominal.thickness)
    print(" | ".join(("", *HEADINGS, "")).strip(), "|---" * len(HEADINGS) + "|", sep="\n")
    for factor in FACTORS:
        design = dataclasses.replace(
            nominal,
            thickness=factor * nominal.thickness,
            encapsulated_thickness=factor * nominal.encapsulated_thickness,
        )
        for force in FORCES:
            exact = signals(design, Mechanics(), "solved", force)
            found = signals(design, shared, "tabulated", force)
            unmoved = signals(nominal, shared, "tabulated", force)
            error = np.abs(found - exact).max(axis=1) / np.abs(exact).max(axis=1)
            rms, unchanged = (
                np.linalg.norm(each - exact) / np.linalg.norm(exact) for each in (found, unmoved)
            )
            print(
                f"| {factor:.2f} | {force:g} N | {100 * rms:.2f} % | {100 * error.max():.1f} % "
                f"| {100 * unchanged:.1f} % |"
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
