"""Live: a wire breaks while the sensor is touched, and what is made of it."""

import numpy as np

from eitskin.datasets import State
from eitskin.geometry import Bend, SensorDesign
from eitskin.hardware import Script, Step, check_sensor, open_board, run_live
from eitskin.simulator import Scene, Simulator, Touch
from eitskin.training import Pipeline

from style import DIVERGING, GREY, ORANGE, PALE, RED, TEAL, colours, figure, save, wanted

# A virtual board speaks the bytes of a real one over a pseudo-terminal; for a real one the URI is
# "serial:/dev/ttyACM0", and the rest stays as it is. From frame 20 on electrode 5 is open.
sim = Simulator(SensorDesign.reference(), resolution="fast")
touch = Touch(0.112, 0.022, 10.0)
steps = Step(Scene(), 10), Step(Scene(Bend(20.0), (touch,)), 20), Step(Scene(), 16)
uri = "virtual:?speed=max&seed=3&faults=open_electrode@20:5"
pipeline = Pipeline.load("reference.eitmodel")
readings = []
with open_board(uri, simulator=sim, scene=Script(steps, repeat=False)) as board:
    for reading in run_live(board, pipeline, newest=False):
        readings.append(reading)
        if len(readings) == 46:
            break
    print(f"{board.counts.frames} frames, {board.counts.lost} lost")
    assert board.counts.lost == 0

# The seven pairs of that electrode are named and left out; the others still tell the touch.
estimates = [reading.estimate for reading in readings]
print(estimates[25].problems[0])
assert len(estimates[25].problems) == 7
assert all(estimate.state is State.TOUCH for estimate in estimates[10:30])
place = np.array([estimate.touches[0][:2] for estimate in estimates[10:30]])
error = 1e3 * np.hypot(*(place - (touch.x, touch.y)).T)
print(f"touch {error[:10].mean():.1f} mm off before, {error[10:].mean():.1f} mm after the break")
assert error.max() < 9.0

# Asked what is wrong, with the sensor flat and untouched again, the check names the electrode.
check = check_sensor([reading.frame for reading in readings[30:]], pipeline.layout.reference)
print(check.findings[0].message)
assert [finding.electrodes for finding in check.findings] == [(5,)]

if wanted():
    drawn, (above, below) = figure(2, 1, (7.2, 4.2), height_ratios=(1.6, 1.0), sharex=True)
    values = np.array([np.abs(reading.frame.impedance) for reading in readings])
    change = 100.0 * (values / values[:10].mean(axis=0) - 1.0)
    bad = np.array([reading.frame.status for reading in readings]) != 0
    shown = above.imshow(
        np.where(bad, np.nan, change).T, cmap=colours(DIVERGING), vmin=-3, vmax=3, aspect="auto"
    )
    above.imshow(np.where(bad, 1.0, np.nan).T, cmap=colours((RED, RED)), aspect="auto", alpha=0.35)
    above.set_yticks(range(0, 28, 3), sim.protocol.labels[::3], fontsize=7)
    above.set(ylabel="pair", title="change of each value; electrode 5 breaks at frame 20")
    drawn.colorbar(shown, ax=above, label="%", shrink=0.9)
    angles = [estimate.bend_angle_deg for estimate in estimates]
    below.plot([0] * 10 + [20] * 20 + [0] * 16, color=PALE, lw=6, label="true angle [deg]")
    below.plot(angles, color=TEAL, label="estimated angle [deg]")
    below.plot(range(10, 30), error, color=ORANGE, label="error of the touch [mm]")
    below.axvline(19.5, color=GREY, ls=":")
    below.set(xlabel="frame", title="estimates")
    below.legend(loc="upper right", fontsize=8)
    save(drawn, __file__)
