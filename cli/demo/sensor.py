"""The stages about the sensor itself: its electric field, and its change in three scenes."""

import io
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from eitskin.cli.demo.results import WEBP, Picture, StageResult
from eitskin.extras import require
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.scene.scene import Scene, Touch
from eitskin.simulator.simulator import Simulator
from eitskin.training.evaluation.report.drawing import EXTRA

DRIVE = (0, 4)
SCENES = (
    ("touched with 10 N at two positions", Scene(touches=(Touch(0.04, 0.02), Touch(0.11, 0.04)))),
    ("bent by 40 deg", Scene(Bend(40.0))),
    (
        "bent by 40 deg and touched with 10 N at three positions",
        Scene(Bend(40.0), (Touch(0.030, 0.030), Touch(0.075, 0.020), Touch(0.120, 0.040))),
    ),
)


def flat_sensor(design: SensorDesign) -> StageResult:
    """The flat sensor: electrodes, mesh, potential and current, and its resistances."""
    from eitskin.simulator.view.model_pictures import draw_drive, model_for_pictures

    model = model_for_pictures(design)
    resistance = Simulator(design, "fast").measure(Scene()).impedance.real
    numbers = {
        "length_mm": 1e3 * design.outline.length,
        "width_mm": 1e3 * design.outline.width,
        "thickness_mm": 1e3 * design.thickness,
        "electrodes": len(design.electrodes),
        "resistances": len(resistance),
        "smallest_ohm": float(resistance.min()),
        "largest_ohm": float(resistance.max()),
        "cells": len(model.mesh.cells),
        "points": len(model.mesh.points),
    }
    caption = (
        f"The gel from the front with its {len(design.electrodes)} electrodes, the "
        f"{len(model.mesh.cells)} cells of the picture's mesh, and the field of a current of 1 A "
        f"from electrode {DRIVE[0]} to {DRIVE[1]}: potential with lines of equal potential, lines "
        "of current, and current density where it is largest, at the edges of an electrode. "
        "Meshes for measurements are graded more finely."
    )
    image = rendered(lambda path: draw_drive(model, DRIVE, path))
    alt = "Sensor with numbered electrodes, its mesh, potential and current"
    return StageResult(numbers, {"sensor": Picture(alt, caption, WEBP, image, 10.0)})


def deformed_sensor(design: SensorDesign) -> StageResult:
    """The sensor in three scenes, and the change of its resistances."""
    from eitskin.simulator.view.scene_pictures import draw_scenes

    sim = Simulator(design, "fast")
    flat = sim.measure(Scene()).impedance.real
    changes = {
        title: 100.0 * (sim.measure(scene).impedance.real / flat - 1.0) for title, scene in SCENES
    }
    caption = (
        "Three scenes to one scale. Colours: change of the conductance along the sensor, which "
        "falls under a touch and where the bend stretches the gel; rings beside a touch are gel "
        "that was pushed aside."
    )
    image = rendered(lambda path: draw_scenes(sim, SCENES, path))
    numbers = [
        {
            "scene": title,
            "smallest_percent": float(change.min()),
            "largest_percent": float(change.max()),
            "rms_percent": float(np.sqrt(np.mean(change**2))),
        }
        for title, change in changes.items()
    ]
    scenes = Picture("The sensor " + "; ".join(changes), caption, WEBP, image, 6.4)
    return StageResult({"scenes": numbers}, {"scenes": scenes})


def rendered(render: Callable[[Path], None]) -> bytes:
    """Picture that `render` writes as a PNG, as bytes of a WebP file a seventh as large."""
    image, file = require("PIL.Image", EXTRA), io.BytesIO()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        render(path)
        image.open(path).convert("RGB").save(file, "WEBP", quality=85, method=6)
    return file.getvalue()
