"""Repeated loading: presses in a row that creep, dents that linger, and gels that drift and age."""

import dataclasses
from pathlib import Path

import numpy as np

from eitskin.datasets import Recipe
from eitskin.datasets.recipe.frame_sampling import sample, specimen
from eitskin.geometry import SensorDesign
from eitskin.simulator import Scene, Simulator

from style import GREY, ORANGE, PALE, TEAL, figure, save, wanted

SCENES = Path(__file__).parent / "scenes"
scene = Scene.from_toml(SCENES / "repeated.toml")
recipe = Recipe.from_toml(SCENES / "repeated_recipe.toml")
sim = Simulator(SensorDesign.reference(), "fast")
flat = sim.measure(Scene()).impedance.real

# A press held for 2 s, on the fading dent of the one before, against a first press.
first = Scene(touches=(dataclasses.replace(scene.touches[0], held=0.0),))
changes = [np.abs(sim.measure(each).impedance.real / flat - 1.0).max() for each in (first, scene)]
print(f"largest change: {100 * changes[0]:.3f} % of a first press, {100 * changes[1]:.3f} % later")
assert changes[1] > changes[0]

# The recipe presses twelve times in 264 s: the gel is not at rest before the next press, so that
# what is left over grows from press to press, towards the slowest of the gel's relaxations.
length = recipe.frames // 8
starts = np.array([sample(recipe, k).time for k in range(length)])
after = (1, 4, 11)  # presses
before = [int(np.searchsorted(starts, 22.0 * k - 1e-6)) - 1 for k in after]
left = sim.measure_all([sample(recipe, k).scene for k in before]).real
left_over = 100.0 * np.abs(left / flat - 1.0).max(axis=1)
print(f"left before the next press: {left_over[0]:.4f} % after one, {left_over[-1]:.4f} % after 11")
assert (np.diff(left_over) > -1e-9).all()
assert 1.2 < left_over[-1] / left_over[0] < 5.0

# The board drifts with the gel's temperature within a session. Age is a sensor of other numbers:
# the recipe's specimens differ as gels do that have dried, stiffened or lost contact.
ages = [specimen(recipe, number) for number in range(8)]
conductivities = np.array([each.design.conductivity for each in ages])
print(f"conductivities from {conductivities.min():.2f} to {conductivities.max():.2f} S/m")
assert np.ptp(np.log(conductivities)) > 0.2

if wanted():
    drawn, (above, below) = figure(2, 1, (7.2, 4.0), sharex=True)
    times = np.arange(0, 270, 4)
    shown = [int(np.searchsorted(starts, time)) for time in times if time < starts[-1]]
    seen = sim.measure_all([sample(recipe, k).scene for k in shown]).real
    change = 100.0 * (seen / flat - 1.0)
    channel = int(np.abs(change).max(axis=0).argmax())
    above.plot(starts[shown], change[:, channel], color=TEAL, lw=1.2)
    above.set(ylabel="change [%]", title=f"pair {sim.protocol.labels[channel]}, without noise")
    for k in range(12):
        above.axvspan(22 * k, 22 * k + 10, color=PALE, zorder=0)
    below.plot(22.0 * np.array(after), left_over, "o-", color=ORANGE)
    below.axhline(0.0, color=GREY, lw=0.8)
    below.set(
        xlabel="time [s]", ylabel="change [%]", title="left before the next press, of any pair"
    )
    save(drawn, __file__)
