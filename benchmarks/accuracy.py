"""Error against run time of the forward model: `python -m eitskin.benchmarks.accuracy`.

For each resolution, on one core: the error of the 28 flat resistances against the converged
hp-FEM values (z = 1e-4 ohm m2), and the error of the signal of bent and pressed scenes against a
mesh finer than `fine`, beside the time per frame after meshing.
"""

import dataclasses
import time
from typing import cast

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry import Bend, SensorDesign
from eitskin.geometry.structured import Grading
from eitskin.simulator import ForwardModel, Protocol, Scene, Simulator, Touch
from eitskin.simulator.forward import RESOLUTIONS, Resolution

Array = NDArray[np.float64]

# hp-FEM, converged to nine digits: pairs (0,1) .. (0,7), and the sum over all 28 [ohm].
HP_FIRST = (530.08615, 718.93029, 744.02202, 720.20649, 548.07843, 470.82818, 407.32498)
HP_SUM = 16209.0957
HP_CONTACT = 1e-4

FINER = ((4, 2), Grading(finest=2.5e-5, coarsest=4e-3, growth=2.0, layers=1))
SCENES = {
    "bend 50": Scene(Bend(50.0)),
    "bend -20": Scene(Bend(-20.0)),
    "10 N": Scene(touches=(Touch(0.050, 0.020),)),
    "10 N by an electrode": Scene(touches=(Touch(0.075, 0.052),)),
    "10 N, bend 30": Scene(Bend(30.0), (Touch(0.110, 0.035),)),
    "10 N in the bend": Scene(Bend(30.0), (Touch(0.075, 0.030),)),
}


def signals(sim: Simulator) -> dict[str, Array]:
    """Relative change of each measurement that each scene makes: of the bend, or of the press."""
    found = {}
    for name, scene in SCENES.items():
        before = Scene(bend=scene.bend) if scene.touches else Scene()
        reference = sim.measure(before).impedance.real
        found[name] = sim.measure(scene).impedance.real / reference - 1.0
    return found


def resistance_error(resolution: Resolution) -> float:
    """Largest relative error of the seven published flat resistances and of their sum."""
    design = SensorDesign.reference()
    electrodes = [
        dataclasses.replace(electrode, contact_impedance=HP_CONTACT)
        for electrode in design.electrodes
    ]
    design = dataclasses.replace(design, electrodes=tuple(electrodes))
    R = Protocol.pairwise(8).measure(ForwardModel(design, resolution).impedance())
    errors = [*(R[:7] / HP_FIRST - 1.0), R.sum() / HP_SUM - 1.0]
    return float(np.abs(errors).max())


def seconds_per_frame(sim: Simulator, repeats: int = 5) -> float:
    """Median time of a new bent and pressed scene [s]."""
    times = []
    for i in range(repeats):
        scene = Scene(Bend(10.0 + i), (Touch(0.050, 0.020), Touch(0.100, 0.040)))
        start = time.perf_counter()
        sim.measure(scene)
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def main() -> None:
    """Print the table."""
    design = SensorDesign.reference()
    finer = Simulator(design, FINER)
    truth = signals(finer)
    names = "".join(f"{name:>22}" for name in SCENES)
    print(f"{'':10}{'unknowns':>10}{'ms/frame':>10}{'error of R':>12}{names}")
    for resolution in RESOLUTIONS:
        sim = Simulator(design, cast(Resolution, resolution))
        own = signals(sim)
        errors = [np.linalg.norm(own[n] - truth[n]) / np.linalg.norm(truth[n]) for n in SCENES]
        print(
            f"{resolution:10}{sim.model.unknowns:10}{1e3 * seconds_per_frame(sim):10.1f}"
            f"{resistance_error(cast(Resolution, resolution)):12.1e}"
            + "".join(f"{error:22.1e}" for error in errors)
        )


if __name__ == "__main__":
    main()
