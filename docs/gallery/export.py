"""Export: the fields of a bent and pressed sensor as VTK files, as ParaView opens them."""

import tempfile
from pathlib import Path

import numpy as np
import pyvista

from eitskin.geometry import Bend, SensorDesign
from eitskin.simulator import Scene, Simulator, Touch
from eitskin.simulator.view.vtu import field_resolution, scene_grids, write_grids

from style import RISING, TEAL, colours, figure, save, wanted

# Cells of 6 mm are enough for the numbers; the picture takes the 2.5 mm of `eitskin export vtu`.
design = SensorDesign.reference()
sim = Simulator(design, field_resolution(design, None if wanted() else 0.006))
scene = Scene(Bend(30.0), (Touch(0.050, 0.030, 10.0),))
with tempfile.TemporaryDirectory() as folder:
    write_grids(scene_grids(sim, scene, [(7, 3)]), folder)
    body = pyvista.read(Path(folder) / "body.vtu")
    electrodes = pyvista.read(Path(folder) / "electrodes.vtp")
print(f"fields: {', '.join(body.array_names)}")

# The file holds the simulator's values: the voltage between the electrodes is the resistance.
potential = electrodes.cell_data["potential_7_3_V_per_A"]
numbers = electrodes.cell_data["electrode"]
voltage = potential[numbers == 7].mean() - potential[numbers == 3].mean()
measured = sim.measure(scene).impedance.real[sim.protocol.table.index((3, 7, 3, 7))]
print(f"{voltage:.3f} V per A, measured {measured:.3f} ohm")
assert abs(voltage / measured - 1.0) < 1e-9

# The gel keeps its volume, bent and pressed.
volume = body.compute_cell_sizes().cell_data["Volume"].sum()
print(f"volume {1e6 * volume:.2f} cm3 of {1e6 * 0.150 * 0.060 * 0.005:.2f}")
assert abs(volume / (0.150 * 0.060 * 0.005) - 1.0) < 0.01

if wanted():
    # The top face from above, coloured by the current that flows beneath it, and the side view.
    drawn, (above, below) = figure(2, 1, (7.2, 4.2), height_ratios=(2.0, 1.0), sharex=True)
    current = np.linalg.norm(body.cell_data["current_density_7_3_A_per_m2_per_A"], axis=1)
    middles = 1e3 * body.cell_centers().points
    flat = body.points - body.point_data["displacement_m"]
    heights = np.unique(flat[:, 2].round(9))
    top = flat[:, 2] > heights[-1] - 1e-9
    shown = above.tricontourf(*middles[:, :2].T, np.log10(current), 30, cmap=colours(RISING))
    lines = 1e3 * body.points[top]
    above.tricontour(*lines[:, :2].T, body.point_data["potential_7_3_V_per_A"][top], 30,
                     colors="white", linewidths=0.5, linestyles="solid")  # fmt: skip
    above.set_aspect("equal")
    above.axis("off")
    above.set_title("current density and potential, 1 A from 7 to 3")
    drawn.colorbar(shown, ax=above, label="log of A/m2", shrink=0.8, pad=0.02)
    row = np.abs(flat[:, 1] - 0.030) < 1e-9
    for height in heights:
        line = row & (np.abs(flat[:, 2] - height) < 1e-9)
        order = np.argsort(flat[line, 0])
        below.plot(*(1e3 * body.points[line][order][:, [0, 2]]).T, color=TEAL, lw=1)
    below.set_aspect("equal")
    below.axis("off")
    below.set_title("cut along the middle")
    save(drawn, __file__)
