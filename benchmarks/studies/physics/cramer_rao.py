"""Cramer-Rao bounds of touches and bends of the reference sensor.

Run by `python -m eitskin.benchmarks.studies.physics.cramer_rao`.

Prints, as Markdown, Cramer-Rao bounds of the reference sensor under the white noise of
`Instrument()`: of one touch at the paper's 27 positions, of one to four touches at random places
and bends, and of the bend angle. With `--out FOLDER` writes every bound to `cramer-rao.csv` and
draws that of one touch over the sensor into `cramer-rao.png`; with `--steps` prints how far the
bounds depend on the steps of the differences, and nothing else.
"""

import argparse
import itertools
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from eitskin.benchmarks.results import write_table
from eitskin.benchmarks.studies.physics.cramer_rao_plot import draw_map
from eitskin.benchmarks.studies.physics.signals import FORCES, POSITIONS
from eitskin.datasets.recipe.touch_sampling import draw_positions
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.provenance import Provenance
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.scene.touch import Touch
from eitskin.simulator.simulator import Simulator
from eitskin.training.evaluation.cramer_rao import (
    SceneBound,
    SceneDerivatives,
    Steps,
    scene_derivatives,
)

Array = NDArray[np.float64]

SEED = 0
BENDS = (0.0, 30.0)
ANGLES = tuple(np.arange(-20.0, 51.0, 10.0).tolist())
MOST_TOUCHES, SCENES = 4, 16  # random scenes of each number of touches
MARGIN, SPACING, FORCE = 0.010, 0.030, 10.0
REFERENCES = {"one frame": 1.0, "long average": math.inf}
PLACE_STEPS = (4e-3, 2e-3, 1e-3, 5e-4, 2.5e-4)
LENGTH, WIDTH = 0.150, 0.060
# The sensor mirrors itself in both its middle lines: a quarter of it says all. IMAGES counts, for
# each position of that quarter, the paper's positions that mirror it; then the map, and the nodes
# at which it is solved [m].
IMAGES = Counter((round(min(x, LENGTH - x), 6), min(y, WIDTH - y)) for x, y in POSITIONS)
MAP_X, MAP_Y = np.linspace(0.006, 0.075, 139), np.linspace(0.006, 0.030, 49)
NODES = np.arange(0.006, 0.0811, 0.003), np.arange(0.006, 0.0361, 0.003)


@dataclass(frozen=True, slots=True)
class BoundRow:
    """Bound of one touch, or of the angle of an untouched scene.

    Attributes:
        experiment: "positions", "random" or "angle".
        touches: how many the scene has.
        x_mm, y_mm, force: of the touch; NaN without one [mm], [N].
        angle_deg: of the bend.
        reference: name of `REFERENCES`.
        factor_known: whether nothing has drifted.
        distance_mm: bound of the mean distance between true and found place.
        place_mm: bound of the root of its mean square.
        force_n: bound of the force's deviation [N].
        angle_bound_deg: bound of the angle's deviation.
    """

    experiment: str
    touches: int
    x_mm: float
    y_mm: float
    force: float
    angle_deg: float
    reference: str
    factor_known: bool
    distance_mm: float
    place_mm: float
    force_n: float
    angle_bound_deg: float


def bounds(
    sim: Simulator, experiment: str, scenes: Iterable[Scene], factors: Sequence[bool] = (True,)
) -> Iterator[BoundRow]:
    """Rows of scenes, for every reference, with and without a drift where asked."""
    for scene in scenes:
        found = scene_derivatives(sim, scene)
        noise = found.noise(Instrument(), sim.full_scale)
        for reference, known in itertools.product(REFERENCES, factors):
            least = found.bound(noise, REFERENCES[reference], factor_known=known)
            yield from _rows(experiment, scene, least, reference, known)


def _rows(
    experiment: str, scene: Scene, least: SceneBound, reference: str, known: bool
) -> Iterator[BoundRow]:
    nan = math.nan
    each = [
        (1e3 * touch.x, 1e3 * touch.y, touch.force, 1e3 * distance, 1e3 * place, force)
        for touch, distance, place, force in zip(
            scene.touches, least.distance, least.place, least.force, strict=True
        )
    ]
    for x, y, pressed, distance, place, force in each or [(nan,) * 6]:
        yield BoundRow(
            experiment=experiment,
            touches=len(scene.touches),
            x_mm=x,
            y_mm=y,
            force=pressed,
            angle_deg=scene.bend.angle_deg,
            reference=reference,
            factor_known=known,
            distance_mm=distance,
            place_mm=place,
            force_n=force,
            angle_bound_deg=least.angle_deg,
        )


def single(force: float, angle_deg: float) -> list[Scene]:
    """One touch at each of the paper's positions in a quarter of the sensor."""
    return [Scene(Bend(angle_deg), (Touch(x, y, force),)) for x, y in IMAGES]


def several() -> list[Scene]:
    """One to four touches at random places and bends."""
    rng = np.random.default_rng(SEED)
    scenes = []
    for amount in np.repeat(np.arange(1, MOST_TOUCHES + 1), SCENES).tolist():
        places = draw_positions(amount, Rectangle(LENGTH, WIDTH), MARGIN, SPACING, rng)
        bend = Bend(float(rng.uniform(*BENDS)))
        scenes.append(Scene(bend, tuple(Touch(x, y, FORCE) for x, y in places.tolist())))
    return scenes


def position_table(rows: Sequence[BoundRow]) -> str:
    """Mean distance [mm] at each position, by force and bend, and over the paper's 27."""
    cases = list(itertools.product(FORCES, BENDS))
    lines = [["x, y [mm]", *(f"{force:g} N, {angle:g} deg" for force, angle in cases)]]
    found = {name: [distances(rows, name, *case) for case in cases] for name in REFERENCES}
    for number, (x, y) in enumerate(IMAGES):
        cells = [f"{each[number]:.2f}" for each in found["one frame"]]
        lines.append([f"{1e3 * x:.0f}, {1e3 * y:.0f}", *cells])
    for name, columns in found.items():
        means = (np.average(each, weights=list(IMAGES.values())) for each in columns)
        lines.append([f"mean of 27, {name}", *(f"{mean:.2f}" for mean in means)])
    return markdown(lines)


def distances(rows: Sequence[BoundRow], reference: str, force: float, angle_deg: float) -> Array:
    """Mean distances [mm] of all rows of one case."""
    case = (reference, force, angle_deg)
    return np.array([r.distance_mm for r in rows if (r.reference, r.force, r.angle_deg) == case])


def random_table(rows: Sequence[BoundRow]) -> str:
    """Means over scenes of each number of touches."""
    lines = [["touches", "reference", "place [mm]", "median", "force [N]", "angle [deg]"]]
    for touches, reference in itertools.product(range(1, MOST_TOUCHES + 1), REFERENCES):
        part = [r for r in rows if (r.touches, r.reference) == (touches, reference)]
        distance = [r.distance_mm for r in part]
        force, angle = [r.force_n for r in part], [r.angle_bound_deg for r in part]
        numbers = (np.mean(distance), np.median(distance), np.mean(force), np.mean(angle))
        lines.append([f"{touches}", reference, *(f"{number:.2f}" for number in numbers)])
    return markdown(lines)


def angle_table(rows: Sequence[BoundRow]) -> str:
    """Table of the bounds of the untouched sensor, by angle."""
    cases = list(itertools.product(REFERENCES, (True, False)))
    drift = {True: "", False: ", unknown drift"}
    lines = [["angle [deg]", *(f"{reference}{drift[known]}" for reference, known in cases)]]
    for angle in ANGLES:
        found = {(r.reference, r.factor_known): r for r in rows if r.angle_deg == angle}
        lines.append([f"{angle:g}", *(f"{found[case].angle_bound_deg:.3f}" for case in cases)])
    return markdown(lines)


def step_table(sim: Simulator) -> str:
    """Mean distance [mm] of 10 N by the step of the differences."""
    lines = [["angle [deg], x, y [mm]", *(f"{1e3 * step:g} mm" for step in PLACE_STEPS)]]
    for angle, (x, y) in itertools.product(BENDS, IMAGES):
        scene, cells = Scene(Bend(angle), (Touch(x, y, FORCE),)), []
        for step in PLACE_STEPS:
            found = scene_derivatives(sim, scene, Steps(place=step))
            noise = found.noise(Instrument(), sim.full_scale)
            cells.append(f"{1e3 * found.bound(noise).distance[0]:.3f}")
        lines.append([f"{angle:g}, {1e3 * x:.0f}, {1e3 * y:.0f}", *cells])
    return markdown(lines)


def markdown(lines: Sequence[Sequence[str]]) -> str:
    """A table, its head first."""
    ruled = [lines[0], ["---"] * len(lines[0]), *lines[1:]]
    return "\n".join("| " + " | ".join(line) + " |" for line in ruled)


def quarter_map(sim: Simulator) -> Array:
    """Mean distance [mm] of 10 N on the flat sensor against a long average, (MAP_Y, MAP_X).

    Logarithms of resistances are smooth and are interpolated by cubic splines between `NODES`; the
    bound has narrow ridges, where moving one way hardly changes any, and is not.
    """
    steps = Steps()
    less, more = (logarithms(sim, FORCE * (1.0 + by), 0.0) for by in (-steps.force, steps.force))
    before, after = (logarithms(sim, FORCE, by) for by in (-steps.angle_deg, steps.angle_deg))
    level = 0.5 * (less + more)
    by_force = (more - less) / (2.0 * FORCE * steps.force)
    by_touch = [_finer(level, 1, 0), _finer(level, 0, 1), _finer(by_force)]
    by_angle = _finer((after - before) / (2.0 * steps.angle_deg))
    resistance = np.exp(_finer(level))
    found = np.empty(by_angle.shape[:2])
    for at in np.ndindex(found.shape):
        touch = np.stack([slope[at] for slope in by_touch])
        derivatives = SceneDerivatives(resistance[at], touch[None], by_angle[at])
        noise = derivatives.noise(Instrument(), sim.full_scale)
        found[at] = 1e3 * derivatives.bound(noise, math.inf).distance[0]
    return found


def logarithms(sim: Simulator, force: float, angle_deg: float) -> Array:
    """Logarithms of the resistances under a touch at each of the `NODES`, (y, x, measurements)."""
    x, y = NODES
    scenes = [Scene(Bend(angle_deg), (Touch(a, b, force),)) for b in y for a in x]
    measured = sim.measure_all(scenes, tolerance=0.0).real
    found: Array = np.log(measured).reshape(len(y), len(x), -1)
    return found


def _finer(values: Array, by_x: int = 0, by_y: int = 0) -> Array:
    """Derivatives of values on the `NODES`, on the map."""
    x, y = NODES
    along = make_interp_spline(x, values, axis=1)(MAP_X, by_x)
    found: Array = make_interp_spline(y, along, axis=0)(MAP_Y, by_y)
    return found


def main() -> None:
    """Print the tables, write and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, help="folder to write and draw into")
    parser.add_argument("--steps", action="store_true", help="print the dependence on the steps")
    arguments = parser.parse_args()
    sim = Simulator(SensorDesign.reference(), "fast")
    where = str(Provenance.now(SEED))
    print(f"{where}\n")
    if arguments.steps:
        print(step_table(sim))
        return
    positions = [
        row
        for case in itertools.product(FORCES, BENDS)
        for row in bounds(sim, "positions", single(*case))
    ]
    print(f"## one touch: mean distance [mm]\n\n{position_table(positions)}\n")
    random = list(bounds(sim, "random", several()))
    print(f"## touches of {FORCE:g} N at 0 to 30 deg: means\n\n{random_table(random)}\n")
    bent = (Scene(Bend(angle)) for angle in ANGLES)
    angles = list(bounds(sim, "angle", bent, factors=(True, False)))
    print(f"## bend angle, untouched [deg]\n\n{angle_table(angles)}")
    if arguments.out:
        table = arguments.out / "cramer-rao.csv"
        write_table(table, [asdict(row) for row in (*positions, *random, *angles)], where)
        picture = arguments.out / "cramer-rao.png"
        draw_map(sim.design, (MAP_X, MAP_Y), quarter_map(sim), picture)
        print(f"\ntable: {table}\npicture: {picture}")


if __name__ == "__main__":
    main()
