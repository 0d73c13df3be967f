"""Quick models of presses against the 3D one: `python -m eitskin.benchmarks.touches`.

Solves presses on the reference sensor in 3D, at the 27 positions (what is symmetric once), near its
edges, and two to four at several distances, and prints how far the signals of quick models are from
that, relative to the norm of the signal: of tabulated dents with their images beyond the free
edges, of the same without, and of the closed form. It takes minutes per press.
"""

import argparse
import itertools
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.bends import signal
from eitskin.benchmarks.provenance import Provenance
from eitskin.geometry import SensorDesign
from eitskin.geometry.deformation import Deformation
from eitskin.geometry.grading import Grading
from eitskin.simulator import Scene, Simulator, Touch
from eitskin.simulator.dented import DentedStack
from eitskin.simulator.dents import Dents
from eitskin.simulator.equilibrium import SolidError
from eitskin.simulator.pressed import PressedStack
from eitskin.simulator.presses import dents

Array = NDArray[np.float64]
Model = Callable[[tuple[Touch, ...]], Deformation]

FORCE = 10.0
# Of the 27 positions, those that are not mirror images of another.
POSITIONS = tuple(itertools.product((0.075, 0.060, 0.045, 0.030, 0.015), (0.030, 0.015)))
EDGES = (0.012, 0.010, 0.0075, 0.005)  # from a side of the gel [m]
SPACINGS = (0.015, 0.020, 0.030, 0.045, 0.060)  # between the axes of two touches [m]
MESHES = (
    Grading(finest=0.0020, coarsest=0.009, growth=0.35, layers=2),
    Grading(finest=0.0020, coarsest=0.006, growth=0.35),
    Grading(finest=0.0015, coarsest=0.009, growth=0.35),
)
COARSE = Grading(finest=0.003, coarsest=0.012, growth=0.6)


@dataclass(frozen=True, slots=True)
class Case:
    """Presses to compare models on.

    Attributes:
        family: "position", "long side", "short side", "two", "three" or "four".
        distance: from the nearest side of the gel, or between neighbours [m].
        touches: the presses.
    """

    family: str
    distance: float
    touches: tuple[Touch, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """One case, solved.

    Attributes:
        case: what was pressed.
        full: the 3D equilibrium.
        full_seconds: to find it.
        signal: relative changes of the resistances that it makes, (m,).
        errors: of the signals of other models, over the norm of the signal, by model.
        seconds: that these took per frame.
        depth, thinning: of the first touch in the tabulated model [m], [-].
    """

    case: Case
    full: DentedStack
    full_seconds: float
    signal: Array
    errors: dict[str, float]
    seconds: dict[str, float]
    depth: float
    thinning: float


def cases(force: float = FORCE) -> list[Case]:
    """All presses, those in the middle first."""

    def touches(*places: tuple[float, float]) -> tuple[Touch, ...]:
        return tuple(Touch(x, y, force) for x, y in places)

    found = [Case("position", min(x, y), touches((x, y))) for x, y in POSITIONS]
    found += [Case("long side", y, touches((0.075, y))) for y in EDGES]
    found += [Case("short side", x, touches((x, 0.030))) for x in EDGES]
    for d in SPACINGS:
        found.append(Case("two", d, touches((0.075 - d / 2, 0.030), (0.075 + d / 2, 0.030))))
    for d in (0.030, 0.045):
        row = [(0.075 + k * d, 0.030) for k in (-1, 0, 1)]
        found.append(Case("three", d, touches(*row)))
    for d in (0.020, 0.030):
        corners = itertools.product((0.075 - d / 2, 0.075 + d / 2), (0.030 - d / 2, 0.030 + d / 2))
        found.append(Case("four", d, touches(*corners)))
    return found


def quick_models(sim: Simulator) -> dict[str, Model]:
    """What is compared with the 3D model."""

    def unbounded(touches: tuple[Touch, ...]) -> Deformation:
        places = {(touch.x, touch.y) for touch in touches}
        presses = dents(touches, sim.design, sim.mechanics, "tabulated").presses
        return Dents(tuple(press for press in presses if (press.x, press.y) in places))

    return {
        "tabulated": lambda touches: dents(touches, sim.design, sim.mechanics, "tabulated"),
        "without images": unbounded,
        "closed form": lambda touches: dents(touches, sim.design, sim.mechanics, "closed form"),
    }


def compared(
    sim: Simulator, chosen: Iterable[Case], grading: Grading | None = None
) -> Iterator[Compared | str]:
    """Every case, solved, or why it cannot be."""
    for case in chosen:
        start = time.perf_counter()
        try:
            (full,) = PressedStack(sim.design, case.touches, sim.mechanics, grading).pressed()
        except SolidError as error:
            yield f"{case.family} {1e3 * case.distance:g} mm: {error}"
            continue
        full_seconds = time.perf_counter() - start
        change = signal(sim, full)
        errors, seconds = {}, {}
        for name, model in quick_models(sim).items():
            start = time.perf_counter()
            difference = signal(sim, model(case.touches)) - change
            seconds[name] = time.perf_counter() - start
            errors[name] = float(np.linalg.norm(difference) / np.linalg.norm(change))
        press = sim.presses(Scene(touches=case.touches))[0]
        yield Compared(
            case, full, full_seconds, change, errors, seconds, press.depth, press.thinning
        )


def print_row(one: Compared) -> None:
    """What became of one case."""
    x, y = one.case.touches[0].x, one.case.touches[0].y
    errors = " ".join(f"{100 * error:7.1f}" for error in one.errors.values())
    print(
        f"{one.case.family:>10} {1e3 * one.case.distance:5.1f}  ({1e3 * x:5.1f}, {1e3 * y:4.1f})  "
        f"{errors}  {100 * np.abs(one.signal).max():5.2f}  "
        f"{1e3 * one.full.depths[0]:5.2f} {1e3 * one.depth:5.2f}  "
        f"{100 * one.full.thinnings[0]:4.1f} {100 * one.thinning:4.1f}  {one.full_seconds:5.0f}",
        flush=True,
    )


def print_meshes(sim: Simulator, touch: Touch) -> None:
    """How much the 3D signal of one press changes on finer meshes and in a wider window."""
    reference = None
    for reach, grading in [(None, None), (0.060, None), *((None, g) for g in MESHES)]:
        start = time.perf_counter()
        stack = PressedStack(sim.design, (touch,), sim.mechanics, grading, reach)
        (full,) = stack.pressed()
        change = signal(sim, full)
        reference = change if reference is None else reference
        apart = np.linalg.norm(change - reference) / np.linalg.norm(reference)
        print(
            f"{grading or 'as used'}, reach {reach or 'as used'}: {stack.solid.unknowns} unknowns, "
            f"{time.perf_counter() - start:.0f} s, depth {1e3 * full.depths[0]:.2f} mm, thinning "
            f"{full.thinnings[0]:.1%}, signal {apart:.1%} apart",
            flush=True,
        )


def main() -> None:
    """Print the tables."""
    options = argparse.ArgumentParser(description="Presses: quick models against the 3D one.")
    options.add_argument("--quick", action="store_true", help="few cases on coarse cells")
    options.add_argument("--meshes", action="store_true", help="finer meshes of one press instead")
    options.add_argument("--force", type=float, default=FORCE, help="of every press [N]")
    options.add_argument("--only", nargs="*", help="families of cases")
    options.add_argument("--plot", type=Path, help="where to write a picture")
    chosen = options.parse_args()
    sim = Simulator(SensorDesign.reference())
    print(Provenance.now(seed=0))
    if chosen.meshes:
        print_meshes(sim, Touch(0.075, 0.015, chosen.force))
        return
    wanted = [c for c in cases(chosen.force) if not chosen.only or c.family in chosen.only]
    if chosen.quick:
        wanted = [c for c in wanted if c.family in ("position", "two")][::5]
    print("case, distance, first touch [mm]; errors of tabulated, without images, closed form [%];")
    print(
        "largest change [%]; depth 3D, tabulated [mm]; thinning 3D, tabulated [%]; 3D [s]",
        flush=True,
    )
    found = []
    for one in compared(sim, wanted, COARSE if chosen.quick else None):
        if isinstance(one, str):
            print(one, flush=True)
            continue
        print_row(one)
        found.append(one)
    for name in quick_models(sim) if found else ():
        print(f"{name}: {np.mean([one.seconds[name] for one in found]):.2f} s per frame")
    if chosen.plot:
        from eitskin.benchmarks.touches_plot import plot

        plot(found, chosen.plot)


if __name__ == "__main__":
    main()
