"""A small training set: told by a recipe, simulated, kept as HDF5 and read back."""

import tempfile
from pathlib import Path

import numpy as np

from eitskin.datasets import Recipe, State, open_dataset, save_dataset, touch_maps
from eitskin.datasets.generation.shard_simulation import simulate_frames

from style import GOLD, GREY, RISING, TEAL, circle, colours, figure, save, sensor, wanted

# A recipe decides over everything: two sensors whose conductivity and contacts differ, measured
# by a board with all terms of the AD5940's chain.
RECIPE = """
name = "small"
seed = 4
resolution = "fast"
instrument = { board = "ad5940" }
specimens = { count = 2, conductivity = 0.15, contact_impedance = 0.15 }

[[scenes]]
state = "idle"
count = 12

[[scenes]]
state = "bend"
count = 12
angle_deg = [-20, 50]

[[scenes]]
state = "touch"
count = 24
per_bend = 8
angle_deg = [-20, 50]
touches = [1, 3]
force = [8, 12]
"""

# `eitskin generate small.toml --out DIR` would do the same on all cores. Here it is done in memory.
with tempfile.TemporaryDirectory() as folder:
    (Path(folder) / "small.toml").write_text(RECIPE)
    recipe = Recipe.from_toml(Path(folder) / "small.toml")
    save_dataset(simulate_frames(recipe, range(recipe.frames)), Path(folder) / "small")
    data = open_dataset(Path(folder) / "small")

counts = {state.name.lower(): int((data.state == state).sum()) for state in State}
print(f"{len(data)} frames of {len(data.reference)} sensors: {counts}")
assert counts == {"idle": 12, "bend": 12, "touch": 24}
assert data.impedance.shape == (48, 28)

# A frame depends on recipe, seed and number alone, in whatever company it is made.
again = simulate_frames(recipe, [30, 7])
assert np.allclose(again.impedance, data.impedance[[30, 7]], rtol=1e-4)

# Whole sensors are dealt out for training and testing, so a test sees sensors that are new.
train, test = data.split((0.5, 0.5))
assert not set(data.specimen[train]) & set(data.specimen[test])

if wanted():
    drawn, (left, right) = figure(1, 2, (7.2, 2.8), width_ratios=(1.0, 1.1))
    change = np.abs(data.impedance) / np.abs(data.reference[data.specimen]) - 1.0
    for state, colour in ((State.IDLE, GREY), (State.BEND, GOLD), (State.TOUCH, TEAL)):
        of = data.state == state
        left.plot(data.bend_angle_deg[of], 100.0 * change[of, 1], "o", ms=4, color=colour,
                  label=state.name.lower())  # fmt: skip
    left.set(xlabel="bend angle [deg]", ylabel="change of pair 0-2 [%]", title="48 frames")
    left.legend()
    most = int(data.touch_count.argmax())
    one = slice(most, most + 1)
    places = touch_maps(data.touch_x[one], data.touch_y[one], data.touch_radius[one])[0]
    right.imshow(places, origin="lower", extent=(0, 150, 0, 60), cmap=colours(RISING))
    sensor(right, recipe.sensor, fill=False)
    touches = np.stack([data.touch_x[most], data.touch_y[most], data.touch_force[most]], axis=1)
    for x, y, force in touches.tolist():
        if np.isfinite(x):
            circle(right, x, y, f"{force:.0f} N", of_text="white")
    right.set_title(f"touches of frame {most}, and its touch map")
    save(drawn, __file__)
