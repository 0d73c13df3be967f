"""Sensitivity: where on the sheet a pair of electrodes feels, by the adjoint Jacobian."""

import numpy as np

from eitskin.geometry import SensorDesign
from eitskin.simulator import ForwardModel, Protocol

from style import RISING, colours, figure, save, sensor, wanted

# The derivative of every value by the conductivity of every cell of the mesh, from one
# factorisation.
design, protocol = SensorDesign.reference(), Protocol.pairwise(8)
model = ForwardModel(design, resolution="fast")
J = model.sensitivity(protocol)
R = protocol.measure(model.impedance()).real

# Euler: a sensor that conducts half as well, with contacts twice as resistive, has twice the
# resistance. So R is what both derivatives add up to, and the discrete model knows it exactly.
contact = model.contact_sensitivity(protocol)
added = -J.sum(axis=1) * design.conductivity + contact @ model.contact_impedance
print(f"Euler's identity holds to {np.abs(added / R - 1.0).max():.0e}")
assert np.abs(added / R - 1.0).max() < 1e-9

# A patch that conducts 1 % better, once by the Jacobian and once solved anew.
middles = model.mesh.points[model.mesh.cells].mean(axis=1)
patch = np.hypot(middles[:, 0] - 0.05, middles[:, 1] - 0.03) < 0.0125
linear = 0.01 * J[:, patch].sum(axis=1)
solved = protocol.measure(model.impedance(1.0 + 0.01 * patch)).real - R
error = np.linalg.norm(linear - solved) / np.linalg.norm(solved)
print(f"first order misses {error:.2%} of the change")
assert 0.0 < error < 0.01

if wanted():
    # For pictures, the same by the columns of a grid, whatever the cells are.
    rows, columns = 12, 30
    by_pixel = model.sensitivity(protocol, pixels=(rows, columns))
    drawn, axes = figure(2, 2, (7.2, 3.9))
    pairs = ((0, 4), (1, 5), (3, 7), (0, 7))
    for each, pair in zip(axes.flat, pairs, strict=True):
        number = protocol.table.index((*pair, *pair))
        # Per relative change of R and per area, so that pixels of any size look alike.
        picture = -100 * by_pixel[number].reshape(rows, columns) / R[number] / (25.0 / 100.0)
        shown = each.imshow(
            picture, origin="lower", extent=(0, 150, 0, 60), cmap=colours(RISING),
            vmin=0, vmax=4, interpolation="bicubic",
        )  # fmt: skip
        sensor(each, design, fill=False)
        each.set_title(f"pair {pair[0]}-{pair[1]}")
    label = "fall of R where 1 cm2 conducts\ntwice as well, to first order [%]"
    drawn.colorbar(shown, ax=axes, label=label, shrink=0.7, extend="max")
    save(drawn, __file__)
