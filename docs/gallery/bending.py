"""Bending: resistances over the angle of two plates, and where their axis lies decides."""

import numpy as np

from eitskin.geometry import Bend, Clamp, Hinge, SensorDesign
from eitskin.simulator import Scene, Simulator

from style import GREY, INK, ORANGE, PALE, TEAL, figure, save, wanted

# Two plates clamp the ends and turn about an axis 8 mm below mid-layer, so the gel is stretched
# when it bends upwards and compressed when it bends downwards.
design = SensorDesign.reference()
angles = np.arange(-20, 51, 10)


def changes(fixture: Clamp | Hinge, angles: np.ndarray = angles) -> np.ndarray:
    """Change of the 28 resistances [%], (angles, 28)."""
    sim = Simulator(design, resolution="fast", fixture=fixture)
    flat = sim.measure(Scene()).impedance.real
    bent = sim.measure_all([Scene(Bend(float(angle))) for angle in angles]).real
    return 100.0 * (bent / flat - 1.0)


clamped = changes(Clamp())
print(f"pair 0-1 at -20 and 50 deg: {clamped[0, 0]:+.2f} and {clamped[-1, 0]:+.2f} %")
assert abs(clamped[0, 0] + 0.96) < 0.03
assert abs(clamped[-1, 0] - 1.91) < 0.03

# A strip contracts sideways when it is stretched. The kinematic hinge is a plate that keeps its
# width, and pairs with an electrode in the middle of a long side then change by twice as much.
plate = changes(Hinge())
halved = clamped[-1, 0] / plate[-1, 0]
print(f"as a plate pair 0-1 changes by {plate[-1, 0]:+.2f} %; the clamp makes {halved:.2f} of that")
assert 0.4 < halved < 0.5

# With the axis in mid-layer up and down are alike, and the sign of a bend could not be told.
up, down = changes(Hinge(offset=0.0), np.array([20, -20]))
assert np.abs(up).max() > 0.1
assert np.abs(up - down).max() < 1e-4

if wanted():
    drawn, (left, right) = figure(1, 2, (7.2, 2.9), width_ratios=(1.1, 1.0))
    for angle, colour in ((-20.0, GREY), (20.0, TEAL), (50.0, ORANGE)):
        bent = Simulator(design, "fast").deformation(Scene(Bend(angle)))
        assert bent is not None
        x = np.linspace(0.0, 0.150, 400)
        faces = [np.stack([x, 0.03 + 0 * x, np.full_like(x, z)], axis=-1) for z in (0.0, 0.005)]
        below, above = (1e3 * bent.positions(face)[:, [0, 2]] for face in faces)
        left.fill(*np.vstack([below, above[::-1]]).T, color=colour, alpha=0.85, lw=0)
        left.text(*(below[0] + (-3, 0)), f"{angle:+.0f} deg", color=colour, ha="right", va="center")
    left.plot(75.0, 2.5 - 8.0, "o", color=INK, ms=4)
    left.annotate("axis", (75.0, -5.5), (75.0, -14.0), ha="center", va="top", fontsize=8)
    left.set_aspect("equal")
    left.set(title="the gel from the side", xlim=(-30, 152), ylim=(-32, 20))
    left.axis("off")
    for pair, name, colour in ((0, "0-1", ORANGE), (2, "0-3", TEAL), (5, "0-6", GREY)):
        right.plot(angles, clamped[:, pair], color=colour, label=f"pair {name}")
        right.plot(angles, plate[:, pair], color=colour, ls="--")
    right.axhline(0.0, color=PALE, lw=1, zorder=0)
    right.set(xlabel="bend angle [deg]", ylabel="change [%]", title="clamp (-) and plate (- -)")
    right.legend()
    save(drawn, __file__)
