"""The first parts of a demo: the bare sensor, and what bends and presses do to it."""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eitskin.cli.demo.parts import PNG, Part, Picture, drawn_picture
from eitskin.cli.demo.pictures import changed_resistances
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.scene.touch import Touch
from eitskin.simulator.simulator import Simulator
from eitskin.training.evaluation.report.drawing import style

DRIVE = (0, 4)
SCENES = (
    ("pressed with 10 N at two places", Scene(touches=(Touch(0.040, 0.020), Touch(0.110, 0.040)))),
    ("bent by 40 deg", Scene(Bend(40.0))),
    (
        "bent by 40 deg and pressed with 10 N at three places",
        Scene(Bend(40.0), (Touch(0.030, 0.030), Touch(0.075, 0.020), Touch(0.120, 0.040))),
    ),
)


def sensor(design: SensorDesign) -> Part:
    """The flat sensor: electrodes, cells, a potential, a current, and its resistances."""
    from eitskin.simulator.view.model_pictures import draw_drive, model_for_pictures

    frame = Simulator(design, "fast").measure(Scene())
    model = model_for_pictures(design)
    resistance = frame.impedance.real
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
        f"{len(model.mesh.cells)} cells of the picture's mesh, and what a current of 1 A from "
        f"electrode {DRIVE[0]} to {DRIVE[1]} does: potential with lines of equal potential, lines "
        "of current, and current density where it is largest, at the edges of an electrode. "
        "Meshes that measure are graded more finely."
    )
    drawing = _rendered(lambda path: draw_drive(model, DRIVE, path))
    alt = "Sensor with numbered electrodes, its mesh, potential and current"
    return Part(numbers, {"sensor": Picture(alt, caption, PNG, drawing, 10.0)})


def states(design: SensorDesign) -> Part:
    """The sensor in three scenes, and what these do to its resistances."""
    from eitskin.simulator.view.scene_pictures import draw_scenes

    sim = Simulator(design, "fast")
    flat = sim.measure(Scene()).impedance.real
    changes = [100.0 * (sim.measure(scene).impedance.real / flat - 1.0) for _, scene in SCENES]
    titles = [title for title, _ in SCENES]
    drawing = _rendered(lambda path: draw_scenes(sim, SCENES, path))
    caption = (
        "Three scenes to one scale. Colours: change of the conductance along the sensor, which "
        "falls under a press and where the bend stretches the gel; rings beside a press are gel "
        "that was pushed aside. Between the scenes nothing else differs."
    )
    with style():
        chart = changed_resistances(titles, changes, sim.protocol.labels)
    pictures = {
        "scenes": Picture("The sensor " + "; ".join(titles), caption, PNG, drawing, 6.4),
        "changes": drawn_picture(chart, "Change of every resistance in the three scenes"),
    }
    return Part({"scenes": _largest(titles, changes)}, pictures)


def _largest(
    titles: Sequence[str], changes: Sequence[NDArray[np.float64]]
) -> list[dict[str, object]]:
    """Reach and root mean square of the changes [%] of each scene."""
    return [
        {
            "scene": title,
            "smallest_percent": float(change.min()),
            "largest_percent": float(change.max()),
            "rms_percent": float(np.sqrt(np.mean(change**2))),
        }
        for title, change in zip(titles, changes, strict=True)
    ]


def _rendered(render: Callable[[Path], None]) -> bytes:
    """The PNG file that `render` writes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        render(path)
        return path.read_bytes()
