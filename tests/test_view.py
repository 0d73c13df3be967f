"""Pictures: drawn without a screen, and showing what changed."""

import numpy as np
import pytest

from eitskin.geometry import Bend, SensorDesign
from eitskin.simulator import Scene, Simulator, Touch
from eitskin.simulator.view import conductance_change, draw


@pytest.fixture(scope="module")
def sim() -> Simulator:
    return Simulator(SensorDesign.reference(), "fast")


def test_conductance_falls_under_a_press_and_where_the_layer_is_stretched(sim) -> None:
    points = np.array([[0.05, 0.02, 0.0025], [0.02, 0.05, 0.0025]])
    pressed = conductance_change(sim, Scene(touches=(Touch(0.05, 0.02),)), points)
    assert pressed[0] < -0.4
    assert abs(pressed[1]) < 0.02
    middle = np.array([[0.075, 0.03, 0.004]])
    assert conductance_change(sim, Scene(bend=Bend(40.0)), middle)[0] < -0.1
    assert conductance_change(sim, Scene(), middle)[0] == 0.0


def test_a_bent_pressed_sensor_is_drawn_in_colour(sim, tmp_path) -> None:
    from PIL import Image

    path = tmp_path / "scene.png"
    draw(sim, [("bent and pressed", Scene(Bend(40.0), (Touch(0.05, 0.02),)))], path)
    pixels = np.asarray(Image.open(path).convert("RGB")).astype(int)
    red = (pixels[..., 0] > 100) & (pixels[..., 1] < 60) & (pixels[..., 2] < 60)
    assert (pixels.min(axis=2) < 250).mean() > 0.1
    assert red.sum() > 500
