"""Kinematic bend models against the 3D bend.

Run by `python -m eitskin.benchmarks.studies.physics.bends`.

Prints, as Markdown, for the reference sensor in the default clamp, the solution of the 3D model of
the clamped stack and how far the bend signals of kinematic models are from it, relative to the norm
of the signal.
"""

import itertools
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Bend, Hinge
from eitskin.geometry.deformation.kinematics import Deformation
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator.bends.bend_3d import BentStack, ClampedStack, bend_grading
from eitskin.simulator.bends.bend_table import BendTable
from eitskin.simulator.mechanics.load_stepping import SolidError
from eitskin.simulator.simulator import Simulator

Array = NDArray[np.float64]

ANGLES = (-20.0, 10.0, 20.0, 30.0, 50.0, 70.0, 90.0)
BETWEEN = (-15.0, 5.0, 25.0, 45.0, 82.0)
SPANS = (0.040, 0.044, 0.048)
TRANSITIONS = (0.0, 0.004, 0.006, 0.008, 0.012)
CONTRACTIONS = (0.0, 0.25, 0.5, 0.7, 0.8, 1.0)
SOLVED = ("energy [mJ]", "moment about the axis [mN m]", "least and largest change of the 28")
# The first is what is used; the others are finer in the thickness and at the edges of the plates.
MESHES = (
    bend_grading(0.012),
    replace(bend_grading(0.012), layers=2),
    Grading(finest=0.0005, coarsest=0.009, growth=0.8),
)


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """Solution of the 3D model at one angle.

    Attributes:
        bent: the equilibrium.
        signal: relative change of each measurement, (m,).
        solve_seconds, frame_seconds: to find the one and the other.
    """

    bent: BentStack
    signal: Array
    solve_seconds: float
    frame_seconds: float


def signal(sim: Simulator, deformation: Deformation) -> Array:
    """Relative change of each resistance that a deformation makes, (m,)."""
    flat = sim.protocol.measure(sim.model.impedance()).real
    change: Array = sim.deformed(deformation).impedance.real / flat - 1.0
    return change


def solved(
    sim: Simulator, stack: ClampedStack, angles_deg: Sequence[float]
) -> tuple[list[Solved], list[str]]:
    """Solutions of the 3D model at all angles it reaches, and the reasons for the other angles."""
    found, refused = [], []
    downwards = sorted((a for a in angles_deg if a < 0.0), reverse=True)
    for path in (downwards, sorted(a for a in angles_deg if a >= 0.0)):
        equilibria = stack.equilibria(path)
        try:
            for _ in path:
                start = time.perf_counter()
                bent = next(equilibria)
                between = time.perf_counter()
                change = signal(sim, bent)
                end = time.perf_counter()
                found.append(Solved(bent, change, between - start, end - between))
        except SolidError as error:
            refused.append(str(error))
    return sorted(found, key=lambda s: s.bent.angle_deg), refused


def errors(sim: Simulator, hinge: Hinge, references: Sequence[Solved]) -> Array:
    """Error of the kinematic signal over norm of the signal, per angle; inf where it refuses."""
    found = []
    for reference in references:
        try:
            flexure = hinge.flexure(sim.design, Bend(reference.bent.angle_deg))
        except ConfigurationError:
            found.append(np.inf)
            continue
        difference = np.linalg.norm(signal(sim, flexure) - reference.signal)
        found.append(float(difference / np.linalg.norm(reference.signal)))
    return np.array(found)


def compared(
    sim: Simulator, hinges: Iterable[Hinge], references: Sequence[Solved]
) -> dict[Hinge, Array]:
    """`errors` of several kinematic models, the one with the smallest mean first."""
    found = {hinge: errors(sim, hinge, references) for hinge in hinges}
    return dict(sorted(found.items(), key=lambda item: float(item[1].mean())))


def between(
    sim: Simulator, stack: ClampedStack, angles_deg: Sequence[float]
) -> tuple[float, dict[float, float]]:
    """Seconds to solve a table of bends, and the error of its signals between what was solved."""
    start = time.perf_counter()
    table = BendTable.of(stack)
    seconds = time.perf_counter() - start
    direct, _ = solved(sim, stack, angles_deg)
    found = {}
    for s in direct:
        difference = np.linalg.norm(signal(sim, table.at(s.bent.angle_deg)) - s.signal)
        found[s.bent.angle_deg] = float(difference / np.linalg.norm(s.signal))
    return seconds, found


def print_solved(references: Sequence[Solved], refused: Sequence[str]) -> None:
    """Print results of the 3D model, and where it stops."""
    print_head("3D", ("angle", *SOLVED, "solve [s]", "frame [s]"))
    for s in references:
        print(
            f"| {s.bent.angle_deg:g} | {1e3 * s.bent.energy:.2f} | {1e3 * s.bent.moment:.1f} "
            f"| {100 * s.signal.min():+.2f} .. {100 * s.signal.max():+.2f} % "
            f"| {s.solve_seconds:.1f} | {s.frame_seconds:.2f} |"
        )
    print(*refused, sep="\n", end="\n" if refused else "")


def print_meshes(sim: Simulator, references: Sequence[Solved], angle_deg: float) -> None:
    """Print the change of the signal at one angle on finer meshes."""
    used = next(s.signal for s in references if s.bent.angle_deg == angle_deg)
    for grading in MESHES[1:]:
        ((finer,), _) = solved(sim, ClampedStack(sim.design, grading=grading), (angle_deg,))
        change = np.linalg.norm(used - finer.signal) / np.linalg.norm(finer.signal)
        print(
            f"- signal at {angle_deg:+g} deg on {grading.layers} layers from "
            f"{1e3 * grading.finest:g} mm, apart [%] and solved in [s]: {100 * change:.2f}, "
            f"{finer.solve_seconds:.0f}"
        )


def print_kinematic(sim: Simulator, references: Sequence[Solved]) -> None:
    """Print the errors of kinematic models against the 3D model."""
    angles = (f"{s.bent.angle_deg:g}" for s in references)
    print_head("kinematic", ("bends, transition [mm], contraction", *angles, "mean"))
    hinges = [
        Hinge(span, give=0.0, transition=transition, contraction=contraction)
        for span, transition, contraction in itertools.product(SPANS, TRANSITIONS, CONTRACTIONS)
    ]
    start = time.perf_counter()
    for model, error in compared(sim, hinges, references).items():
        print(
            f"| {1e3 * model.span:.0f}, {1e3 * model.transition:.0f}, {model.contraction:g} | "
            + " | ".join(f"{100 * e:.1f}" for e in (*error, error.mean()))
            + " |"
        )
    frames = len(hinges) * len(references)
    print(f"\n- kinematic frame [s]: {(time.perf_counter() - start) / frames:.2f}")


def print_head(title: str, columns: Sequence[str]) -> None:
    """Print the head of a table in Markdown."""
    print(f"\n## {title}\n", f"| {' | '.join(columns)} |", "|---" * len(columns) + "|", sep="\n")


def main() -> None:
    """Print everything."""
    # The simulator of a hinge without transition has faces at the clamps, which suits all.
    sim = Simulator(SensorDesign.reference(), "standard", Hinge(give=0.0))
    stack = ClampedStack(sim.design, grading=MESHES[0])
    references, refused = solved(sim, stack, ANGLES)
    print_solved(references, refused)
    print_meshes(sim, references, 20.0)
    seconds, errors_between = between(sim, stack, BETWEEN)
    print(f"\n- table of bends [s]: {seconds:.0f}")
    for angle, error in errors_between.items():
        print(f"- signal between what was solved, at {angle:g} deg, off by [%]: {100 * error:.3f}")
    print_kinematic(sim, references)


if __name__ == "__main__":
    main()
