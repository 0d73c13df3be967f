"""The first tutorial's scene: the sensor as a scene bends and dents it, by `simulate --view`."""

import re
import tomllib
from pathlib import Path

import numpy as np

from eitskin.config import from_dict
from eitskin.geometry import SensorDesign
from eitskin.simulator import Scene, Simulator

from style import wanted

page = Path(__file__).parents[1] / "tutorials" / "first-touch.md"
(text,) = re.findall(r"```toml\n(# scene.toml\n.*?)```", page.read_text(), re.DOTALL)
scene = from_dict(Scene, tomllib.loads(text), "scene.toml")

sim = Simulator(SensorDesign.reference())
flat, bent = (sim.measure(each).impedance.real for each in (Scene(), scene))
change = 100.0 * (bent / flat - 1.0)
print(f"resistances change by {change.min():+.2f} to {change.max():+.2f} %")
assert np.abs(change).max() > 1.0

folder = wanted()
if folder is not None:
    from eitskin.simulator.view.scene_pictures import draw_scenes

    draw_scenes(sim, [("bent by 30 deg and touched with 10 N", scene)], folder / "scene.png")
