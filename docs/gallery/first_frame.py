"""The first frame: 28 resistances of the flat, untouched sensor."""

import dataclasses

import numpy as np

from eitskin.geometry import SensorDesign
from eitskin.simulator import Scene, Simulator

from style import DIVERGING, GREY, RISING, colours, figure, save, sensor, wanted

# The sensor of the paper: 150 x 60 x 5 mm of hydrogel, eight electrodes on its rim. A simulator
# meshes it once; `measure` then gives the frame of any scene, here of nothing happening at all.
design = SensorDesign.reference()
sim = Simulator(design)
frame = sim.measure(Scene())
resistance = frame.impedance.real
for label, value in list(zip(frame.protocol.labels, resistance, strict=True))[:7]:
    print(f"{label}  {value:7.2f} ohm")
assert len(resistance) == 28

# Left and right of the sensor are mirror images, so pairs that mirror each other are equal.
pairs = {
    frozenset(map(int, label.split("-"))): R
    for label, R in zip(frame.protocol.labels, resistance, strict=True)
}
assert abs(pairs[frozenset({0, 7})] / pairs[frozenset({2, 3})] - 1.0) < 1e-9

# With better contacts, 1e-4 ohm m2, there are values of an hp finite element method to compare
# with, which are good to nine digits.
better = tuple(dataclasses.replace(e, contact_impedance=1e-4) for e in design.electrodes)
found = Simulator(dataclasses.replace(design, electrodes=better)).measure(Scene()).impedance.real
exact = [530.08615, 718.93029, 744.02202, 720.20649, 548.07843, 470.82818, 407.32498]
error = np.abs(found[:7] / exact - 1.0).max()
print(f"largest error {error:.1e}")
assert error < 1e-3

if wanted():
    # Potential on the top face for a current from electrode 4 to electrode 0.
    drawn, (left, right) = figure(1, 2, (7.2, 2.7), width_ratios=(1.75, 1.0))
    mesh, u = sim.model.mesh, sim.model.potentials().real
    top = mesh.points[:, 2] > design.thickness - 1e-9
    x, y = 1e3 * mesh.points[top, 0], 1e3 * mesh.points[top, 1]
    potential = (u[:, 4] - u[:, 0])[top]
    potential -= 0.5 * (potential.max() + potential.min())  # seen from the middle
    levels = left.tricontourf(x, y, potential, 24, cmap=colours(DIVERGING))
    left.tricontour(x, y, potential, 24, colors="white", linewidths=0.4)
    sensor(left, design, fill=False)
    left.set_title("potential, 1 A from 4 to 0")
    drawn.colorbar(
        levels, ax=left, label="V", shrink=0.6, pad=0.02, ticks=[-400, -200, 0, 200, 400]
    )
    table = np.full((8, 8), np.nan)
    for pair, R in pairs.items():
        table[min(pair), max(pair)] = table[max(pair), min(pair)] = R
    shown = right.imshow(table, cmap=colours(RISING))
    right.set(xticks=range(8), yticks=range(8), title="resistance of each pair")
    right.tick_params(length=0, colors=GREY)
    right.spines[:].set_visible(False)
    drawn.colorbar(shown, ax=right, label="ohm", shrink=0.8)
    save(drawn, __file__)
