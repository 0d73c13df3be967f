"""Quick models of presses against the 3D press.

Run by `python -m eitskin.benchmarks.studies.physics.touches`.

Solves presses on the reference sensor in 3D, at the 27 positions (what is symmetric once), near its
edges, and two to four at several distances, and prints how far the signals of quick models are from
that, relative to the norm of the signal: of tabulated dents with their images beyond the free
edges, of the same without, and of the closed form. It takes minutes per press, so every case is
written to `--out FILE` when it is solved, and one that is there already is not solved again.
"""

import argparse
import csv
import itertools
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.results import write_table
from eitskin.benchmarks.studies.physics.bends import signal
from eitskin.geometry.deformation.kinematics import Deformation
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.provenance import Provenance
from eitskin.simulator.layer.dents import Dents
from eitskin.simulator.layer.pressed_touches import dents
from eitskin.simulator.mechanics.load_stepping import SolidError
from eitskin.simulator.mechanics.press_3d import PressedStack
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.scene.touch import Touch
from eitskin.simulator.simulator import Simulator

Array = NDArray[np.float64]
Model = Callable[[tuple[Touch, ...]], Deformation]

FORCE = 10.0
# Those of the 27 positions that are not mirror images of another.
POSITIONS = tuple(itertools.product((0.075, 0.060, 0.045, 0.030, 0.015), (0.030, 0.015)))
EDGES = (0.012, 0.010, 0.0075, 0.005)  # from a side of the gel [m]
SPACINGS = (0.015, 0.020, 0.030, 0.045, 0.060)  # between the axes of two touches [m]
# Each against the first: cells as used in a window as used, and all of the sensor.
MESHES: tuple[tuple[float | None, Grading | None], ...] = (
    (None, None),
    (0.048, None),
    (0.160, None),
    (None, Grading(finest=0.0025, coarsest=0.006, growth=0.35)),
    (None, Grading(finest=0.0025, coarsest=0.006, growth=0.35, layers=2)),
)
COARSE = Grading(finest=0.003, coarsest=0.012, growth=0.6)


@dataclass(frozen=True, slots=True)
class PressCase:
    """Presses of one scene to compare models on.

    Attributes:
        family: "position", "long side", "short side", "two", "three" or "four".
        distance: from the nearest side of the gel, or between neighbours [m].
        touches: the presses.
    """

    family: str
    distance: float
    touches: tuple[Touch, ...]


@dataclass(frozen=True, slots=True)
class Compared:
    """Errors of the models in one case.

    Attributes:
        family, distance_mm: of the case.
        touches_mm: places of the touches.
        tabulated, without_images, closed_form: errors of the signals of these models, over the
            norm of the signal of the 3D one.
        tabulated_s, without_images_s, closed_form_s, full_s: time of a frame; to press in 3D [s].
        largest_change: of a resistance in 3D, relative.
        depth_mm, thinning: of the first touch in 3D.
        tabulated_depth_mm, tabulated_thinning: of the same, tabulated.
        area_mm2, pressure_kPa: of its contact in 3D; mean pressure.
    """

    family: str
    distance_mm: float
    touches_mm: str
    tabulated: float
    without_images: float
    closed_form: float
    tabulated_s: float
    without_images_s: float
    closed_form_s: float
    full_s: float
    largest_change: float
    depth_mm: float
    thinning: float
    tabulated_depth_mm: float
    tabulated_thinning: float
    area_mm2: float
    pressure_kPa: float  # noqa: N815


def cases(force: float = FORCE) -> list[PressCase]:
    """Cases of all presses, those in the middle first."""

    def touches(*places: tuple[float, float]) -> tuple[Touch, ...]:
        return tuple(Touch(x, y, force) for x, y in places)

    found = [PressCase("position", min(x, y), touches((x, y))) for x, y in POSITIONS]
    found += [PressCase("long side", y, touches((0.075, y))) for y in EDGES]
    found += [PressCase("short side", x, touches((x, 0.030))) for x in EDGES]
    for d in SPACINGS:
        found.append(PressCase("two", d, touches((0.075 - d / 2, 0.030), (0.075 + d / 2, 0.030))))
    for d in (0.030, 0.045):
        row = [(0.075 + k * d, 0.030) for k in (-1, 0, 1)]
        found.append(PressCase("three", d, touches(*row)))
    for d in (0.020, 0.030):
        corners = itertools.product((0.075 - d / 2, 0.075 + d / 2), (0.030 - d / 2, 0.030 + d / 2))
        found.append(PressCase("four", d, touches(*corners)))
    return found


def quick_models(sim: Simulator) -> dict[str, Model]:
    """Quick models that are compared with the 3D model."""

    def unbounded(touches: tuple[Touch, ...]) -> Deformation:
        places = {(touch.x, touch.y) for touch in touches}
        presses = dents(touches, sim.design, sim.mechanics, "tabulated").presses
        return Dents(tuple(press for press in presses if (press.x, press.y) in places))

    return {
        "tabulated": lambda touches: dents(touches, sim.design, sim.mechanics, "tabulated"),
        "without_images": unbounded,
        "closed_form": lambda touches: dents(touches, sim.design, sim.mechanics, "closed form"),
    }


def places(case: PressCase) -> str:
    """Positions of the presses as text [mm]."""
    return "; ".join(f"{1e3 * touch.x:.5g} {1e3 * touch.y:.5g}" for touch in case.touches)


def compared(sim: Simulator, case: PressCase, grading: Grading | None = None) -> Compared:
    """Solved case; raises SolidError where there is no equilibrium."""
    start = time.perf_counter()
    (full,) = PressedStack(sim.design, case.touches, sim.mechanics, grading).equilibria()
    full_s = time.perf_counter() - start
    change = signal(sim, full)
    found = {}
    for name, model in quick_models(sim).items():
        start = time.perf_counter()
        difference = signal(sim, model(case.touches)) - change
        found[f"{name}_s"] = time.perf_counter() - start
        found[name] = float(np.linalg.norm(difference) / np.linalg.norm(change))
    press = sim.presses(Scene(touches=case.touches))[0]
    return Compared(
        family=case.family,
        distance_mm=1e3 * case.distance,
        touches_mm=places(case),
        full_s=full_s,
        largest_change=float(np.abs(change).max()),
        depth_mm=1e3 * full.depths[0],
        thinning=full.thinnings[0],
        tabulated_depth_mm=1e3 * press.depth,
        tabulated_thinning=press.thinning,
        area_mm2=1e6 * full.contact_areas[0],
        pressure_kPa=1e-3 * full.mean_pressures[0],
        **found,
    )


def print_row(one: Compared) -> None:
    """Print the row of one case."""
    errors = " ".join(
        f"{100 * e:7.1f}" for e in (one.tabulated, one.without_images, one.closed_form)
    )
    print(
        f"{one.family:>10} {one.distance_mm:5.1f}  ({one.touches_mm})  {errors}  "
        f"{100 * one.largest_change:5.2f}  {one.depth_mm:5.2f} {one.tabulated_depth_mm:5.2f}  "
        f"{100 * one.thinning:4.1f} {100 * one.tabulated_thinning:4.1f}  {one.full_s:5.0f}",
        flush=True,
    )


def print_meshes(sim: Simulator, touch: Touch) -> None:
    """Print the change of the 3D signal of one press on finer meshes and in a wider window."""
    reference = None
    for reach, grading in MESHES:
        start = time.perf_counter()
        stack = PressedStack(sim.design, (touch,), sim.mechanics, grading, reach)
        (full,) = stack.equilibria()
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
    options.add_argument("--out", type=Path, help="table of all cases solved; gone on with")
    options.add_argument("--plot", type=Path, help="where to write a picture")
    chosen = options.parse_args()
    sim = Simulator(SensorDesign.reference())
    print(Provenance.now(seed=0))
    if chosen.meshes:
        print_meshes(sim, Touch(0.075, 0.030, chosen.force))
        return
    wanted = [c for c in cases(chosen.force) if not chosen.only or c.family in chosen.only]
    if chosen.quick:
        wanted = [c for c in wanted if c.family in ("position", "two")][::5]
    found = _solved_before(chosen.out)
    known = {one.touches_mm for one in found}
    print("case, distance, touches [mm]; errors of tabulated, without images, closed form [%];")
    print("largest change [%]; depth 3D, tabulated [mm]; thinning 3D, tabulated [%]; 3D [s]")
    for one in found:
        print_row(one)
    for case in wanted:
        if places(case) in known:
            continue
        try:
            one = compared(sim, case, COARSE if chosen.quick else None)
        except SolidError as error:
            print(f"{case.family} {1e3 * case.distance:g} mm: {error}", flush=True)
            continue
        print_row(one)
        found.append(one)
        if chosen.out:
            write_table(chosen.out, [asdict(each) for each in found], str(Provenance.now(0)))
    if chosen.plot and found:
        from eitskin.benchmarks.studies.physics.touches_plot import plot

        plot(found, chosen.plot)


def _solved_before(path: Path | None) -> list[Compared]:
    """Rows of an existing table."""
    if path is None or not path.is_file():
        return []
    with path.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    text = ("family", "touches_mm")
    return [Compared(**{k: v if k in text else float(v) for k, v in row.items()}) for row in rows]  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
