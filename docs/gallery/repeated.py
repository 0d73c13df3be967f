"""Repeated loading: presses in a row that creep, dents that linger, and gels that drift and age."""

import dataclasses
from pathlib import Path

import numpy as np

from eitskin.datasets import Recipe
from eitskin.datasets.recipe.frame_sampling import sample, specimen
from eitskin.datasets.recipe.specimen import scaled_modulus
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

# The board drifts with the gel's temperature within a session. Age is a sensor of other numbers.
# A gel that has dried and its contacts lost a fifth of their conductance alike, by which all
# resistances grow, and no signal. A gel and silicone that are a tenth stiffer need a force a tenth
# larger for the same signal.
design, mechanics = sim.design, sim.mechanics
contacts = [
    dataclasses.replace(each, contact_impedance=each.contact_impedance / 0.8)
    for each in design.electrodes
]
faded = dataclasses.replace(
    design, conductivity=0.8 * design.conductivity, electrodes=tuple(contacts)
)
resistances = Simulator(faded, "fast").measure(Scene()).impedance.real
print(f"faded: resistances {(resistances / flat).min():.4f} times as large")
assert np.abs(0.8 * resistances / flat - 1.0).max() < 1e-9
stiff = Simulator(
    design,
    "fast",
    mechanics=dataclasses.replace(
        mechanics,
        gel=scaled_modulus(mechanics.gel, 1.1),
        encapsulation=scaled_modulus(mechanics.encapsulation, 1.1),
    ),
)


def signal(sensor: Simulator, force: float) -> np.ndarray:
    """Change of the resistances by a first press [%]."""
    touch = dataclasses.replace(first.touches[0], force=force)
    untouched, pressed = (sensor.measure(each) for each in (Scene(), Scene(touches=(touch,))))
    return np.asarray(100.0 * (pressed.impedance.real / untouched.impedance.real - 1.0))


young, weak, equal = signal(sim, 10.0), signal(stiff, 10.0), signal(stiff, 11.0)
print(f"stiffened: largest change {np.abs(weak).max():.4f} %, before {np.abs(young).max():.4f} %")
assert np.abs(weak).max() < 0.97 * np.abs(young).max()
assert np.abs(equal - young).max() < 1e-3 * np.abs(young).max()

# The recipe's specimens differ as gels do that have dried, stiffened or lost contact.
ages = [specimen(recipe, number) for number in range(8)]
conductivities = np.array([each.design.conductivity for each in ages])
stiffness = [1e-3 * each.mechanics.gel.shear_modulus for each in ages]
sensors = [each.simulator(recipe.sensor, "fast") for each in ages]
felt = np.array([np.abs(signal(each, 10.0)).max() for each in sensors])
print(f"conductivities from {conductivities.min():.2f} to {conductivities.max():.2f} S/m")
print(f"largest change by a first press: {felt.min():.3f} to {felt.max():.3f} %")
assert np.ptp(np.log(conductivities)) > 0.2
assert felt.max() > 1.05 * felt.min()

if wanted():
    drawn, axes = figure(2, 2, (7.2, 4.2))
    for axis in axes[0]:
        axis.remove()
    above, (below, aged) = drawn.add_subplot(axes[0, 0].get_gridspec()[0, :]), axes[1]
    times = np.arange(0, 270, 4)
    shown = [int(np.searchsorted(starts, time)) for time in times if time < starts[-1]]
    seen = sim.measure_all([sample(recipe, k).scene for k in shown]).real
    change = 100.0 * (seen / flat - 1.0)
    channel = int(np.abs(change).max(axis=0).argmax())
    above.plot(starts[shown], change[:, channel], color=TEAL, lw=1.2)
    title = f"twelve touches of 10 N: pair {sim.protocol.labels[channel]}, without noise"
    above.set(xlabel="time [s]", ylabel="change [%]", title=title)
    for k in range(12):
        above.axvspan(22 * k, 22 * k + 10, color=PALE, zorder=0)
    below.plot(22.0 * np.array(after), left_over, "o-", color=ORANGE)
    below.axhline(0.0, color=GREY, lw=0.8)
    below.set(xlabel="time [s]", ylabel="change [%]", title="left before the next, of any pair")
    aged.plot(stiffness, felt, "o", color=TEAL)
    aged.set(
        xlabel="shear modulus of the gel [kPa]",
        ylabel="change [%]",
        title="a first touch at eight ages",
    )
    save(drawn, __file__)
