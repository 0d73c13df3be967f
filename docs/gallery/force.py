"""Contact force: what a force does to the resistances, and how well the pipeline tells it."""

from pathlib import Path

import numpy as np

from eitskin.datasets import Recipe
from eitskin.datasets.recipe.frame_sampling import sample
from eitskin.geometry import SensorDesign
from eitskin.simulator import Frame, Instrument, Scene, Simulator, Touch
from eitskin.training import Pipeline

from style import GREY, ORANGE, TEAL, figure, save, wanted

# The scene names one force; the recipe draws forces of 2 to 12 N, each a label of its frame.
SCENES = Path(__file__).parent / "scenes"
(touch,) = Scene.from_toml(SCENES / "force.toml").touches
recipe = Recipe.from_toml(SCENES / "force_recipe.toml")
labels = [each.force for index in range(60) for each in sample(recipe, index).scene.touches]
print(f"forces of the recipe: {min(labels):.1f} to {max(labels):.1f} N")
assert 2.0 <= min(labels) < 3.0
assert 11.0 < max(labels) <= 12.0

# The signal grows with the force, a little less than in proportion.
sim, rng = Simulator(SensorDesign.reference()), np.random.default_rng(4)
forces = np.array([2.0, 4.0, 6.0, 8.0, 10.0, 12.0])
flat = sim.measure(Scene()).impedance.real
scenes = [Scene(touches=(Touch(touch.x, touch.y, force),)) for force in forces]
signal = [100.0 * np.abs(sim.measure(each).impedance.real / flat - 1.0).max() for each in scenes]
slope = np.polyfit(np.log(forces), np.log(signal), 1)[0]
print(
    f"largest change {signal[0]:.3f} % at 2 N, {signal[-1]:.3f} % at 12 N: force to the {slope:.2f}"
)
assert 0.7 < slope < 1.0

# The pipeline that comes with eitskin learned forces of 4 N and more; the faintest touches of a
# flat sensor are lost in the noise of a single frame.
pipeline = Pipeline.load("reference.eitmodel")
found = []
for number, scene in enumerate([Scene()] * 8 + scenes):
    seen = sim.measure(scene, Instrument(), rng).impedance
    estimate = pipeline.process(Frame(seen, sim.protocol, time=0.3 * number, number=number))
    if scene.touches:
        found.append(estimate.touches[0].force if estimate.touches else np.nan)
for true, told in zip(forces, found, strict=True):
    print(f"{true:4.1f} N " + ("not found" if np.isnan(told) else f"found as {told:.1f} N"))
assert np.abs(np.array(found) - forces)[forces >= 6.0].max() < 2.0

if wanted():
    drawn, (left, right) = figure(1, 2, (7.2, 2.6))
    left.plot(forces, signal, "o-", color=TEAL)
    left.set(xlabel="force [N]", ylabel="largest change [%]", title="signal of a touch")
    right.plot([0, 13], [0, 13], color=GREY, lw=1)
    right.plot(forces, found, "o", color=ORANGE)
    right.set(xlabel="true force [N]", ylabel="estimated [N]", title="estimated force")
    save(drawn, __file__)
