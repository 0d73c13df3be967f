"""Errors of the signals of bent and pressed sensors, by the named resolutions."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.deformation.fixtures import Bend, Hinge
from eitskin.geometry.deformation.kinematics import Displaced
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator.electrical.resolution import Discretisation, Resolution
from eitskin.simulator.scene.indenters import Cylinder, Sphere
from eitskin.simulator.scene.scene import Scene, Touch
from eitskin.simulator.simulator import Simulator

Array = NDArray[np.float64]

# The first is the truth, the second says how far it can be trusted.
References: TypeAlias = tuple[Discretisation, Discretisation]
REFERENCES: References = (
    ((5, 5, 5, 5, 4, 3), Grading(finest=4e-5, coarsest=5e-3, growth=3.0)),
    ((6, 6, 5, 4, 3), Grading(finest=4e-5, coarsest=6e-3, growth=2.5)),
)
QUICK_REFERENCES: References = (
    ((4, 4, 3, 2, 1), Grading(finest=1e-4, coarsest=6e-3, growth=3.0)),
    ((4, 4, 3, 2, 1), Grading(finest=2e-4, coarsest=6e-3, growth=3.0)),
)

# Smooth at the ends of the bend: F may jump at element faces only.
FIXTURE = Hinge(transition=0.010)


def sheared(axis: int) -> Displaced:
    """Simple shear of the whole layer by 45 deg, along x (0) or y (1)."""
    slope = np.zeros((3, 3))
    slope[axis, 2] = 1.0
    return Displaced(
        lambda x: np.asarray(x @ slope.T), lambda x: np.broadcast_to(slope, (*x.shape[:-1], 3, 3))
    )


PRESSES: Mapping[str, Scene] = {
    "10 N": Scene(touches=(Touch(0.060, 0.030),)),
    "10 N in the middle": Scene(touches=(Touch(0.075, 0.030),)),
    "10 N at (45, 15)": Scene(touches=(Touch(0.045, 0.015),)),
    "10 N at (75, 15)": Scene(touches=(Touch(0.075, 0.015),)),
    "10 N by an electrode": Scene(touches=(Touch(0.075, 0.0075),)),
    "2 N, ball": Scene(touches=(Touch(0.060, 0.030, 2.0, Sphere(0.003)),)),
    "2 N, ball at (45, 15)": Scene(touches=(Touch(0.045, 0.015, 2.0, Sphere(0.003)),)),
    "10 N, 20 mm cylinder": Scene(touches=(Touch(0.045, 0.015, 10.0, Cylinder(0.010)),)),
    "10 N, bend 30": Scene(Bend(30.0), (Touch(0.110, 0.035),)),
    "10 N in the bend": Scene(Bend(30.0), (Touch(0.075, 0.030),)),
}
SHEARS: Mapping[str, Displaced] = {"sheared along x": sheared(0), "sheared along y": sheared(1)}
SCENES: Mapping[str, Scene | Displaced] = {
    "bend 50": Scene(Bend(50.0)),
    "bend -20": Scene(Bend(-20.0)),
    **PRESSES,
    **SHEARS,
}
QUICK_SCENES: Mapping[str, Scene | Displaced] = {
    name: SCENES[name] for name in ("bend 50", "10 N", "sheared along x")
}


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

    @property
    def press_error(self) -> float:
        """Largest error of a press."""
        return max(error for name, error in self.signal_errors.items() if name in PRESSES)

    @property
    def shear_error(self) -> float | None:
        """Largest error of a sheared layer; None where none was measured."""
        return max((e for name, e in self.signal_errors.items() if name in SHEARS), default=None)


def signals(
    sim: Simulator, scenes: Mapping[str, Scene | Displaced]
) -> tuple[dict[str, Array], list[float]]:
    """Relative change of each measurement that each scene makes, and the time of each [s]."""
    changes, times = {}, []

    @cache
    def resistances(scene: Scene | Displaced) -> Array:
        start = time.process_time()
        frame = sim.measure(scene) if isinstance(scene, Scene) else sim.deformed(scene)
        times.append(time.process_time() - start)
        return frame.impedance.real

    for name, scene in scenes.items():
        before = Scene()
        if isinstance(scene, Scene) and scene.touches:
            before = Scene(bend=scene.bend)
        changes[name] = resistances(scene) / resistances(before) - 1.0
    return changes, times


def compare_deformed(
    resolutions: Sequence[Resolution],
    references: References,
    scenes: Mapping[str, Scene | Displaced],
) -> tuple[Deformed, ...]:
    """Errors of each resolution, and of the second reference, against the first reference.

    On the reference sensor, bent by a hinge with transitions.
    """
    design = SensorDesign.reference()
    truth, _ = signals(Simulator(design, references[0], FIXTURE), scenes)
    rows = []
    named: dict[str, Resolution | Discretisation]
    named = {"second reference": references[1], **{name: name for name in resolutions}}
    for name, resolution in named.items():
        sim = Simulator(design, resolution, FIXTURE)
        found, times = signals(sim, scenes)
        errors = {
            scene: float(np.linalg.norm(found[scene] - truth[scene]) / np.linalg.norm(truth[scene]))
            for scene in scenes
        }
        rows.append(Deformed(name, sim.model.unknowns, float(np.median(times)), errors))
    return tuple(rows)
