"""A sensor of one's own: six electrodes on another rectangle, and an outline that is none."""

import numpy as np

from eitskin.errors import ConfigurationError
from eitskin.geometry import Electrode, Polygon, Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.simulator import Protocol, Scene, Simulator, Touch

from style import circle, figure, save, sensor, wanted

# A patch of 50 x 30 mm with electrodes in the middles of the short sides and two on each long
# side. Everything else is as with the reference sensor, which keeps its presses solved.
places = [(0.01, 0.0), (0.04, 0.0), (0.05, 0.015), (0.04, 0.03), (0.01, 0.03), (0.0, 0.015)]
patch = SensorDesign(
    outline=Rectangle(0.050, 0.030),
    thickness=0.005,
    electrodes=tuple(Electrode(x, y, width=0.006) for x, y in places),
)
sim = Simulator(patch, resolution="fast")
touch = Touch(x=0.02, y=0.015, force=8.0)
felt = sim.measure(Scene(touches=(touch,))).impedance.real
flat = sim.measure(Scene()).impedance.real
strongest = int(np.abs(felt / flat - 1.0).argmax())
print(f"{len(flat)} values; {sim.protocol.labels[strongest]} feels most,", end=" ")
print(f"{100 * (felt / flat - 1.0)[strongest]:+.2f} %")
assert len(flat) == 6 * 5 // 2
assert np.abs(felt / flat - 1.0).max() > 1e-3

# Any outline will do, such as a pad for a palm: a polygon, counter-clockwise, in metres. The
# twelve electrodes are placed at equal distances along its rim.
corners = [(0.012, 0), (0.058, 0), (0.072, 0.018), (0.080, 0.056), (0.066, 0.082), (0.036, 0.088),
           (0.008, 0.078), (0, 0.030)]  # fmt: skip
outline = Polygon(tuple(corners))
palm = SensorDesign(outline=outline, thickness=0.005, electrodes=uniform(outline, 12, width=0.006))

# Driven and sensed at neighbours there are n (n - 3) values, of which reciprocity leaves half.
protocol = Protocol.adjacent(12)
frame = Simulator(palm, resolution="fast", protocol=protocol).measure(Scene())
print(f"{len(frame.impedance)} values, {protocol.rank} of them independent")
assert len(frame.impedance) == 12 * 9
assert protocol.rank == 12 * 9 // 2

# An impossible design is refused, and the message says why.
try:
    SensorDesign(outline=outline, thickness=0.005, electrodes=uniform(outline, 60, width=0.006))
except ConfigurationError as error:
    print(error)
    assert "overlap" in str(error)
else:
    raise AssertionError("60 electrodes of 6 mm do not fit around 0.26 m")

if wanted():
    drawn, (left, right) = figure(1, 2, (7.2, 3.2), width_ratios=(1.25, 1.0))
    sensor(left, patch)
    circle(left, touch.x, touch.y, "8 N")
    left.set_title("six electrodes, 15 pairs")
    sensor(right, palm)
    right.set_title("twelve, driven at neighbours")
    save(drawn, __file__)
