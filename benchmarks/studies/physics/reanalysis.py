"""Errors of reanalysis by the number of solutions, and by the default tolerance.

Run by `python -m eitskin.benchmarks.studies.physics.reanalysis`.

Prints, as Markdown, by how many percent (median, largest) signals of touches of 5 to 12 N are off
after one to three solutions with the factors of the same bend, of a bend 10 degrees off and of the
flat sensor, and the errors that the default tolerance leaves.
"""

import dataclasses
from collections.abc import Iterable
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.speed.scenes import WORKLOADS, scenes
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.provenance import Provenance
from eitskin.simulator.electrical.reanalysis import Reanalysis
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.simulator import Simulator

Array = NDArray[np.float64]

ANGLE_DEG = 30.0
FACTORISED_DEG = (30.0, 20.0, 0.0)
TOUCHES = {"one touch": (1, 1), "four touches": (4, 4)}
MOST = 3
SCENES, JUDGED = 12, 48
SEED = 3


def main() -> None:
    """Print the table, and errors and solutions by the default tolerance."""
    sim = next(WORKLOADS[0].simulators(1))
    print(Provenance.now(SEED))
    print("\n| bend of the factors |", *(f"solutions: {n} |" for n in range(1, MOST + 1)))
    print("|---" * (1 + MOST) + "|")
    for name, touches in TOUCHES.items():
        for factorised in FACTORISED_DEG:
            errors = 100.0 * after_solutions(sim, factorised, touches)
            cells = (f"{np.median(e):.2g}, {e.max():.2g} |" for e in errors)
            print(f"| {name}, {ANGLE_DEG - factorised:.0f} deg off |", *cells, flush=True)
    print()
    for name, touches in TOUCHES.items():
        errors, solutions = by_default(sim, touches)
        print(f"- {name}, error, median and largest [%]: ", end="")
        print(f"{100.0 * np.median(errors):.3f}, {100.0 * errors.max():.2f}")
        print(f"- {name}, solutions of a scene, mean and most: ", end="")
        print(f"{solutions.mean():.1f}, {solutions.max():.0f}", flush=True)


def after_solutions(sim: Simulator, factorised_deg: float, touches: tuple[int, int]) -> Array:
    """Relative errors of signals after 1, 2, ... solutions, (MOST, SCENES)."""
    solved = Reanalysis(sim.model, sim.deformed_layer(Scene(Bend(factorised_deg))))
    workload = dataclasses.replace(WORKLOADS[0], touches=touches)
    some = [Scene(Bend(ANGLE_DEG), each.touches) for each in scenes(workload, SCENES, SEED)]

    def approximated(scene: Scene) -> Array:
        found = islice(solved.approximations(sim.deformed_layer(scene)), 1, MOST + 1)
        return measured(sim, found)

    untouched = approximated(Scene(Bend(ANGLE_DEG)))
    found = np.stack([approximated(scene) - untouched for scene in some], axis=1)
    return relative_errors(found, signals(sim, some))


def by_default(sim: Simulator, touches: tuple[int, int]) -> tuple[Array, Array]:
    """Relative errors of signals, and solutions of each touched scene, both (JUDGED,)."""
    solved = Reanalysis(sim.model, sim.deformed_layer(Scene()))
    some = scenes(dataclasses.replace(WORKLOADS[0], touches=touches), JUDGED, SEED)
    found, solutions = [], []
    for scene in some:
        flat = solved.impedance(sim.deformed_layer(Scene(scene.bend)))
        before = solved.solutions
        touched = solved.impedance(sim.deformed_layer(scene))
        solutions.append(solved.solutions - before)
        first, second = measured(sim, (flat, touched))
        found.append(second - first)
    return relative_errors(np.array(found), signals(sim, some)), np.array(solutions, dtype=float)


def signals(sim: Simulator, some: list[Scene]) -> Array:
    """Signals of touches [ohm], each scene solved by itself, (scenes, measurements)."""
    both = [*some, *(Scene(scene.bend) for scene in some)]
    found = sim.measure_all(both, tolerance=0.0).real
    changes: Array = found[: len(some)] - found[len(some) :]
    return changes


def measured(sim: Simulator, impedances: Iterable[Array]) -> Array:
    """Measurements [ohm] of impedance matrices, (matrices, measurements)."""
    return np.array([np.real(sim.protocol.measure(Z)) for Z in impedances])


def relative_errors(found: Array, truth: Array) -> Array:
    """Norms of errors over norms of signals, (..., scenes)."""
    errors: Array = np.linalg.norm(found - truth, axis=-1) / np.linalg.norm(truth, axis=-1)
    return errors


if __name__ == "__main__":
    main()
