"""Presses: how deep 10 N go, what the resistances feel of it, and whether two of them add up."""

import numpy as np

from eitskin.geometry import SensorDesign
from eitskin.simulator import Scene, Simulator, Touch

from style import DIVERGING, ORANGE, TEAL, circle, colours, figure, name_pairs, save, sensor, wanted

# A touch is a force on a flat cylinder of 15 mm, unless another indenter is given. How the stack
# of silicone, gel and silicone gives way was solved once at finite strain, and is interpolated.
design = SensorDesign.reference()
sim = Simulator(design, resolution="fast")
left, right = Touch(x=0.045, y=0.018, force=10.0), Touch(x=0.105, y=0.040, force=6.0)
for press in sim.presses(Scene(touches=(left, right))):
    print(
        f"{press.force:4.1f} N: {1e3 * press.depth:.2f} mm deep, gel {press.thinning:.1%} thinner"
    )
first = sim.presses(Scene(touches=(left,)))[0]
assert abs(1e3 * first.depth - 2.69) < 0.01
assert abs(first.thinning - 0.313) < 0.001

# Gel keeps its volume: what leaves from under the indenter thickens a ring around it, and most of
# the signal cancels. A third of the thickness is gone, but no resistance changes by 2 per cent.
flat = sim.measure(Scene()).impedance.real
together, alone, other = (
    100.0 * (sim.measure(Scene(touches=touches)).impedance.real / flat - 1.0)
    for touches in ((left, right), (left,), (right,))
)
print(f"largest change: {np.abs(together).max():.2f} %")
assert 0.1 < np.abs(together).max() < 2.0

# Presses 60 mm apart add up.
missing = np.linalg.norm(together - alone - other) / np.linalg.norm(together)
print(f"the sum of both alone misses {missing:.1%} of the signal of both together")
assert missing < 0.05

if wanted():
    from eitskin.simulator.view.vtu import thinning

    drawn, (above, below) = figure(2, 1, (7.2, 4.6), height_ratios=(1.5, 1.0))
    x, y = np.meshgrid(np.linspace(0, 0.150, 301), np.linspace(0, 0.060, 121))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)
    deformation = sim.deformation(Scene(touches=(left, right)))
    thinner = 100.0 * thinning(sim, deformation, points).reshape(x.shape)
    shown = above.pcolormesh(
        1e3 * x, 1e3 * y, thinner, cmap=colours(DIVERGING), vmin=-31, vmax=31, rasterized=True
    )
    sensor(above, design, fill=False)
    for touch in (left, right):
        circle(above, touch.x, touch.y, f"{touch.force:.0f} N", "white", "white")
    above.set_title("how much thinner the gel is")
    drawn.colorbar(shown, ax=above, label="%", shrink=0.7, pad=0.02)
    pairs = np.arange(28)
    below.bar(pairs - 0.2, together, 0.4, color=TEAL, label="both together")
    below.bar(pairs + 0.2, alone + other, 0.4, color=ORANGE, label="sum of each alone")
    name_pairs(below, sim.protocol.labels)
    below.set(ylabel="change [%]", title="changes of the resistances")
    below.margins(x=0.01)
    below.legend(ncols=2)
    save(drawn, __file__)
