"""Internal electrodes: two more cast into the gel, and what they feel of a press in the middle."""

from pathlib import Path

import numpy as np

from eitskin.datasets import Recipe
from eitskin.datasets.recipe.frame_sampling import specimen
from eitskin.geometry import SensorDesign
from eitskin.simulator import Scene, Simulator

from style import GREY, RED, TEAL, figure, name_pairs, save, sensor, wanted

SCENES = Path(__file__).parent / "scenes"
scene = Scene.from_toml(SCENES / "inside.toml")
recipe = Recipe.from_toml(SCENES / "inside_recipe.toml")
contacts = [specimen(recipe, number).design.electrodes[8].contact_impedance for number in range(5)]
print(f"contact impedances of electrode 8: {min(contacts):.2e} to {max(contacts):.2e} ohm m2")
assert len(set(contacts)) == 5

# The middle of the sheet is far from every electrode of the rim. Two electrodes inside are near.
rim, inside = SensorDesign.reference(), recipe.sensor


def change(design: SensorDesign) -> tuple[tuple[str, ...], np.ndarray]:
    """Pairs of electrodes, and the change of their resistances by the press [%]."""
    sim = Simulator(design, "fast")
    flat, pressed = (sim.measure(each).impedance.real for each in (Scene(), scene))
    return sim.protocol.labels, 100.0 * (pressed / flat - 1.0)


(_, without), (labels, among) = change(rim), change(inside)
best = int(np.abs(among).argmax())
gain = np.abs(among).max() / np.abs(without).max()
print(f"largest change: {np.abs(without).max():.3f} % of 28 pairs at the rim")
print(f"{np.abs(among).max():.3f} % of 45, by pair {labels[best]}: {gain:.1f} times as large")
assert gain > 2.0
assert {"8", "9"} & set(labels[best].split("-"))

# An electrode conducts: the pairs of the rim are those of the sensor without it to some per cent.
own = [labels.index(f"{a}-{b}") for a in range(8) for b in range(a + 1, 8)]
print(f"pairs of the rim: {np.abs(among[own]).max():.3f} %")

if wanted():
    drawn, (above, below) = figure(2, 1, (7.2, 4.6), height_ratios=(1.3, 1.0))
    sensor(above, rim)
    for number in (8, 9):
        electrode = inside.electrodes[number]
        above.plot(1e3 * electrode.x, 1e3 * electrode.y, "s", color="#f0b63c", ms=9)
        above.text(1e3 * electrode.x, 1e3 * electrode.y + 7, str(number), ha="center", fontsize=8)
    above.plot(75, 30, "o", ms=34, mfc="none", mec=RED)
    above.set_title("two electrodes inside, and a touch of 6 N between them")
    order = np.argsort(-np.abs(among))
    colour = [TEAL if {"8", "9"} & set(labels[k].split("-")) else GREY for k in order]
    below.bar(np.arange(45), np.abs(among[order]), color=colour)
    name_pairs(below, [labels[k] for k in order])
    below.set(ylabel="change [%]", title="pairs with an electrode inside (teal), and of the rim")
    below.margins(x=0.01)
    save(drawn, __file__)
