"""How much bends and presses change the 28 resistances: `python -m eitskin.benchmarks.signals`.

Prints, for the reference sensor at `standard`, the change of each pair that starts at electrode 0
and the extremes of all pairs over bend angles, and the largest change of any pair over the
paper's 27 positions at 5 and 10 N.
"""

import itertools

import numpy as np

from eitskin.geometry import Bend, Hinge, SensorDesign
from eitskin.simulator import Scene, Simulator, Touch

ANGLES = (-20.0, -10.0, 10.0, 30.0, 50.0)
POSITIONS = tuple(itertools.product(np.arange(15, 136, 15) * 1e-3, (0.015, 0.030, 0.045)))


def main() -> None:
    """Print the tables."""
    for offset in (0.008, 0.0):
        sim = Simulator(SensorDesign.reference(), "standard", Hinge(offset=offset))
        flat = sim.measure(Scene()).impedance.real
        print(f"hinge offset {1e3 * offset:g} mm: change of pairs 0-1 .. 0-7 and range of all [%]")
        for angle in ANGLES:
            change = 100 * (sim.measure(Scene(bend=Bend(angle))).impedance.real / flat - 1)
            pairs = " ".join(f"{part:+7.3f}" for part in change[:7])
            print(f"  {angle:+4.0f} deg: {pairs}   {change.min():+.3f} .. {change.max():+.3f}")
    for force in (5.0, 10.0):
        largest = []
        for x, y in POSITIONS:
            frame = sim.measure(Scene(touches=(Touch(float(x), y, force),)))
            largest.append(100 * np.abs(frame.impedance.real / flat - 1).max())
        print(
            f"{force:g} N at 27 positions: largest pair {min(largest):.2f} .. {max(largest):.2f} %"
        )


if __name__ == "__main__":
    main()
