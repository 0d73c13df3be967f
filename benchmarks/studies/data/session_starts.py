"""Judgement of session starts: false alarms on flat sensors, and bent and pressed ones told.

Run by `python -m eitskin.benchmarks.studies.data.session_starts`, for `docs/pipeline.md`.

Simulates flat specimens of the recipe `training`, each on an AD5940 of its own, and held-out ones
flat, bent and pressed. Prints, as Markdown, the share of each that is doubted, for several numbers
of known specimens, and by the pipeline that ships, which knows sensors of many clamps.
"""

import argparse
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recipe.frame_sampling import specimen
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.frame import Frame
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.protocol import Protocol
from eitskin.provenance import Provenance
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.scene.touch import Touch
from eitskin.simulator.simulator import Simulator
from eitskin.training.joint.method import JointMethod
from eitskin.training.pipeline.flat_sensors import FlatSensors
from eitskin.training.pipeline.pipeline import Pipeline
from eitskin.training.pipeline.saved_form import SHIPPED

FIRST_HELD_OUT = 2000
PLACES = ((0.02, 0.012), (0.13, 0.048))
ANGLES_DEG = np.linspace(-20.0, 50.0, 29)

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
PROTOCOL = Protocol.pairwise(8)


def scenes(number: int) -> dict[str, Scene]:
    """Starts of one held-out specimen, by name."""
    rng = np.random.default_rng([1, number])
    (x, y), (u, v) = rng.uniform(*PLACES, size=(2, 2)).tolist()
    bends = {f"{angle:+d} deg": Scene(Bend(float(angle))) for angle in (-10, 10, 20, 30)}
    presses = {f"{f} N": Scene(touches=(Touch(x=x, y=y, force=float(f)),)) for f in (3, 9)}
    both = Scene(Bend(30.0), (Touch(x=u, y=v, force=9.0),))
    return {"flat": Scene()} | bends | presses | {"+30 deg, 9 N": both}


class SimulatedSensor:
    """One specimen on a board of its own, every term of the AD5940 included."""

    def __init__(self, recipe: Recipe, number: int) -> None:
        drawn = specimen(recipe, number)
        self._simulator = Simulator(
            drawn.design, recipe.resolution, fixture=drawn.fixture, mechanics=drawn.mechanics
        )
        self._rng = np.random.default_rng([2, number])
        full_scale = self._simulator.full_scale
        self._session = Instrument.ad5940().session(PROTOCOL, full_scale, self._rng)

    def frames(self, scene: Scene, count: int, conductivity: float = 1.0) -> list[Frame]:
        """Frames 0.3 s apart of a still scene, the conductivity of all of it times a factor."""
        truth = (self._simulator.measure(scene).impedance / conductivity).astype(complex)
        rows = (
            self._session.measure(truth[None], np.zeros(1), self._rng)[0][0] for _ in range(count)
        )
        return [Frame(row, PROTOCOL, 0.3 * n, n) for n, row in enumerate(rows)]

    def first(self, scene: Scene) -> Complex:
        """Impedances of the first frame of a scene (measurements,) [ohm]."""
        return self.frames(scene, 1)[0].impedance


def bend_curve(pipeline: Pipeline) -> Array:
    """Learned mean change of the logarithms at `ANGLES_DEG` (angles, measurements)."""
    method = pipeline.method
    if not isinstance(method, JointMethod):
        raise SystemExit("expected a pipeline of the joint method, which has a bend curve")
    return method.bend_prior.of(np.zeros(len(method.features.directions))).value(ANGLES_DEG)


def _print_row(
    name: str, known: FlatSensors, held: Mapping[str, list[Complex]], others: Complex
) -> None:
    """Print the shares of held-out starts, by name, and of other flat sensors that are doubted."""
    shares = [np.mean([bool(known.judge(v).doubt) for v in values]) for values in held.values()]
    rest = [bool(known.judge(values).doubt) for values in others]
    cells = [name, *(f"{100 * share:.0f} %" for share in shares)]
    print("| " + " | ".join([*cells, f"{sum(rest)} of {len(rest)}" if rest else "-"]) + " |")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--specimens", type=int, default=500)
    parser.add_argument("--held-out", type=int, default=60)
    options = parser.parse_args()
    pipeline, recipe = Pipeline.load(SHIPPED), Recipe.shipped("training")
    change = bend_curve(pipeline)
    numbers = range(options.specimens)
    flat = np.array([SimulatedSensor(recipe, n).first(Scene()) for n in numbers])
    held: dict[str, list[Complex]] = {}
    for number in range(FIRST_HELD_OUT, FIRST_HELD_OUT + options.held_out):
        sensor = SimulatedSensor(recipe, number)
        for name, scene in scenes(number).items():
            held.setdefault(name, []).append(sensor.first(scene))
    print("| specimens known | " + " | ".join(held) + " | others flat |")
    print("|---" * (len(held) + 2) + "|")
    for count in sorted({8, 16, 40, 100, 200, options.specimens}):
        known = FlatSensors.fit(flat[:count], ANGLES_DEG, change)
        if count <= options.specimens and known is not None:
            _print_row(str(count), known, held, flat[count:])
    if pipeline.flat_sensors is not None:
        name = f"pipeline, {pipeline.flat_sensors.specimens}"
        _print_row(name, pipeline.flat_sensors, held, flat[:0])
    print("\n", Provenance.now(recipe.seed))


if __name__ == "__main__":
    main()
