"""Errors of the signals of bent and pressed sensors, by the named resolutions."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.deformation.fixtures import Bend
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator.electrical.resolution import Discretisation, Resolution
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.scene.touch import Touch
from eitskin.simulator.simulator import Simulator

Array = NDArray[np.float64]

# The first is the truth, the second says how far it can be trusted.
References: TypeAlias = tuple[Discretisation, Discretisation]
REFERENCES: References = (
    ((4, 3, 3, 2), Grading(finest=5e-5, coarsest=4e-3, growth=2.0)),
    ((3, 2, 2, 1), Grading(finest=5e-5, coarsest=3e-3, growth=2.0)),
)
QUICK_REFERENCES: References = (
    ((3, 2, 2), Grading(finest=1e-4, coarsest=5e-3, growth=2.5)),
    ((3, 2, 1), Grading(finest=2e-4, coarsest=5e-3, growth=2.0)),
)

SCENES: Mapping[str, Scene] = {
    "bend 50": Scene(Bend(50.0)),
    "bend -20": Scene(Bend(-20.0)),
    "10 N": Scene(touches=(Touch(0.050, 0.020),)),
    "10 N by an electrode": Scene(touches=(Touch(0.075, 0.052),)),
    "10 N, bend 30": Scene(Bend(30.0), (Touch(0.110, 0.035),)),
    "10 N in the bend": Scene(Bend(30.0), (Touch(0.075, 0.030),)),
}
QUICK_SCENES: Mapping[str, Scene] = {name: SCENES[name] for name in ("bend 50", "10 N")}


@dataclass(frozen=True, slots=True)
class Deformed:
    """Signal errors of one resolution.

    Attributes:
        name: of the resolution.
        unknowns: of the matrix.
        frame_seconds: median per frame, deformation evaluated, assembled and solved anew.
        signal_errors: per scene, norm of the error of the relative change over norm of the
            change, of the bend or, in scenes that are pressed, of the press.
    """

    name: str
    unknowns: int
    frame_seconds: float
    signal_errors: dict[str, float]


def signals(sim: Simulator, scenes: Mapping[str, Scene]) -> tuple[dict[str, Array], list[float]]:
    """Relative change of each measurement that each scene makes, and the time of each [s]."""
    changes, times = {}, []

    @cache
    def resistances(scene: Scene) -> Array:
        start = time.process_time()
        R = sim.measure(scene).impedance.real
        times.append(time.process_time() - start)
        return R

    for name, scene in scenes.items():
        before = Scene(bend=scene.bend) if scene.touches else Scene()
        changes[name] = resistances(scene) / resistances(before) - 1.0
    return changes, times


def compare_deformed(
    resolutions: Sequence[Resolution], references: References, scenes: Mapping[str, Scene]
) -> tuple[Deformed, ...]:
    """Errors of each resolution, and of the second reference, against the first reference.

    On the reference sensor and its hinge.
    """
    design = SensorDesign.reference()
    truth, _ = signals(Simulator(design, references[0]), scenes)
    rows = []
    named: dict[str, Resolution | Discretisation]
    named = {"second reference": references[1], **{name: name for name in resolutions}}
    for name, resolution in named.items():
        sim = Simulator(design, resolution)
        found, times = signals(sim, scenes)
        errors = {
            scene: float(np.linalg.norm(found[scene] - truth[scene]) / np.linalg.norm(truth[scene]))
            for scene in scenes
        }
        rows.append(Deformed(name, sim.model.unknowns, float(np.median(times)), errors))
    return tuple(rows)
