"""Two axes: a sensor that is bent along and rolled across, and whether its signals add up."""

from pathlib import Path

import numpy as np

from eitskin.datasets import Recipe
from eitskin.datasets.recipe.frame_sampling import sample
from eitskin.geometry import Bend, SensorDesign
from eitskin.geometry.deformation.fixtures import Roll
from eitskin.simulator import Scene, Simulator

from style import INK, ORANGE, TEAL, figure, name_pairs, save, wanted

# Clamps hold the width flat, so the recipe bends by moments alone, a free arc. The touches of a
# scene come first, then the roll about x, then the bend about y.
SCENES = Path(__file__).parent / "scenes"
scene = Scene.from_toml(SCENES / "two_axes.toml")
recipe = Recipe.from_toml(SCENES / "two_axes_recipe.toml")
rolls = [sample(recipe, index).scene.roll for index in range(recipe.frames)]
drawn_deg = [roll.angle_deg for roll in rolls if roll is not None]
print(f"{len(drawn_deg)} of {recipe.frames} frames rolled")
assert len(drawn_deg) == 400
assert -60.0 <= min(drawn_deg) < -50.0 < 50.0 < max(drawn_deg) <= 60.0

design = SensorDesign.reference()
sim = Simulator(design, "fast", fixture=recipe.fixture)


def change(scene: Scene) -> np.ndarray:
    """Change of the 28 resistances [%]."""
    return np.asarray(100.0 * (sim.measure(scene).impedance.real / flat - 1.0))


flat = sim.measure(Scene()).impedance.real
bend, roll = Bend(scene.bend.angle_deg), Roll(scene.roll.angle_deg)  # type: ignore[union-attr]
bent, rolled, both = change(Scene(bend)), change(Scene(roll=roll)), change(Scene(bend, roll=roll))
touched = change(scene) - both
for name, each in (("bend", bent), ("roll", rolled), ("both", both), ("touch", touched)):
    print(f"{name}: rms {np.sqrt(np.mean(each**2)):.3f} %")

# The edges of the rolled sheet lie below the axis of the bend, which compresses them lengthwise:
# what a roll does to the resistances turns its sign when the sensor is bent as well.
missing = np.linalg.norm(both - bent - rolled) / np.linalg.norm(both)
print(f"pair 0-1: {rolled[0]:+.2f} % rolled, {both[0]:+.2f} % rolled and bent")
print(f"the sum of both alone misses {missing:.0%} of the signal of both together")
assert abs(rolled[0] - 0.873) < 0.01
assert both[0] < 0.0
assert missing > 1.0

if wanted():
    drawn, (above, below) = figure(2, 1, (7.2, 5.4), height_ratios=(1.5, 1.0))
    above.remove()
    above = drawn.add_subplot(2, 1, 1, projection="3d")
    x, y = np.meshgrid(np.linspace(0, 0.150, 61), np.linspace(0, 0.060, 25))
    top = np.stack([x, y, 0 * x + design.thickness], axis=-1)
    moved = 1e3 * sim.deformation(scene).positions(top)  # type: ignore[union-attr]
    above.plot_surface(*np.moveaxis(moved, -1, 0), color="#b8dcd9", edgecolor=TEAL, lw=0.2)
    above.set_box_aspect(np.ptp(moved.reshape(-1, 3), axis=0), zoom=1.4)
    above.view_init(32, -62)
    above.set_axis_off()
    above.set_title("bent by 30 deg, rolled by 60 deg, and touched")
    pairs = np.arange(28)
    below.bar(pairs - 0.28, bent, 0.28, color=TEAL, label="bent")
    below.bar(pairs, rolled, 0.28, color=ORANGE, label="rolled")
    below.bar(pairs + 0.28, both, 0.28, color=INK, label="both")
    name_pairs(below, sim.protocol.labels)
    below.set(ylabel="change [%]", title="signals of the curvature")
    below.margins(x=0.01)
    below.legend(ncols=3)
    save(drawn, __file__)
