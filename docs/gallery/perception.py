"""Perception: the pipeline that comes along, on a sensor that it was not trained with."""

import dataclasses

import numpy as np

from eitskin.datasets import State
from eitskin.geometry import Bend, SensorDesign
from eitskin.simulator import Frame, Instrument, Scene, Simulator, Touch
from eitskin.training import Pipeline

from style import RISING, circle, colours, figure, save, sensor, wanted

# A sensor that conducts 10 % better than the design, with noise 75 dB below full scale.
design = dataclasses.replace(SensorDesign.reference(), conductivity=1.1)
sim = Simulator(design)
rng = np.random.default_rng(2)

# A session begins flat and untouched: its first frames become the references. Then the sensor is
# bent, and touched while it is bent.
touches = (Touch(0.030, 0.020, 9.0), Touch(0.075, 0.044, 6.0), Touch(0.118, 0.024, 11.0))
bent = Scene(Bend(30.0))
story = [Scene()] * 8 + [bent] * 4 + [dataclasses.replace(bent, touches=touches)] * 8
pipeline = Pipeline.load("reference.eitmodel")
estimates = []
for number, scene in enumerate(story):
    seen = sim.measure(scene, Instrument(), rng).impedance
    frame = Frame(seen, sim.protocol, time=0.3 * number, number=number)
    estimates.append(pipeline.process(frame))

states = [estimate.state for estimate in estimates]
assert states == [State.IDLE] * 8 + [State.BEND] * 4 + [State.TOUCH] * 8
felt = estimates[-1]
print(f"bent by {felt.bend_angle_deg:.1f} +- {felt.bend_deviation_deg:.1f} deg")
assert abs(felt.bend_angle_deg - 30.0) < 3.0

# Each touch that was found, the true one next to it, and how far apart they are.
for found in felt.touches:
    true = min(touches, key=lambda touch: np.hypot(touch.x - found.x, touch.y - found.y))
    error = np.hypot(true.x - found.x, true.y - found.y)
    print(f"{true.force:4.1f} N found as {found.force:4.1f} N, {1e3 * error:.1f} mm off", end=" ")
    print(f"(standard error {1e3 * found.deviation:.1f} mm)")
    assert error < 8e-3
assert len(felt.touches) == 3

if wanted():
    drawn, axes = figure(1, 1, (7.2, 3.0))
    shown = axes.imshow(felt.touch_map, origin="lower", extent=(0, 150, 0, 60),
                        cmap=colours(RISING), vmin=0, vmax=1, interpolation="bilinear")  # fmt: skip
    sensor(axes, design, fill=False)
    for touch in touches:
        circle(axes, touch.x, touch.y)
    for found in felt.touches:
        axes.plot(1e3 * found.x, 1e3 * found.y, "+", color="white", ms=9, mew=1.6)
    axes.set_title("bent by 30 deg: estimated (map, crosses) and true (circles)")
    drawn.colorbar(shown, ax=axes, label="probability of being touched", shrink=0.75, pad=0.02)
    save(drawn, __file__)
