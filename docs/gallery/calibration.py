"""Calibration: five known angles take most of the error from the angle of a sensor."""

import dataclasses

import numpy as np

from eitskin.geometry import Bend, Clamp, SensorDesign
from eitskin.simulator import Frame, Instrument, Scene, SensorGrid, Simulator
from eitskin.training import Pipeline

from style import GREY, ORANGE, PALE, TEAL, figure, save, wanted

# One's own sensor: 20 % more conductive, clamped 1 mm wider and half a millimetre lower. Nobody
# knows these numbers of a real one. Its bends are interpolated between those that are shipped.
design = dataclasses.replace(SensorDesign.reference(), conductivity=1.2)
clamp, grid = Clamp(span=0.041, offset=0.0085), SensorGrid(span=0.040, offset=0.008)
sim = Simulator(design, resolution="fast", fixture=clamp, grid=grid)
session = Instrument().session(sim.protocol, sim.full_scale, np.random.default_rng(5))
rng = np.random.default_rng(6)


def frames(angles: list[float]) -> list[Frame]:
    """One noisy frame at each angle [deg], 0.3 s apart."""
    clean = sim.measure_all([Scene(Bend(angle)) for angle in angles])
    times = 0.3 * np.arange(len(angles))
    values, _ = session.measure(clean, times, rng)
    return [
        Frame(value, sim.protocol, time, number)
        for number, (value, time) in enumerate(zip(values, times.tolist(), strict=True))
    ]


KNOWN = (-20.0, 15.0, 30.0, 42.5, 50.0)  # more where the angle is told worst

# Eight flat frames, four of each of five angles.
pipeline = Pipeline.load("reference.eitmodel")
asked = [0.0] * 8 + [a for a in np.linspace(-20, 50, 21).tolist() if abs(a) > 2.0]


def errors() -> np.ndarray:
    """Errors of the bent frames of one session [deg]."""
    pipeline.reset()
    estimates = [pipeline.process(frame).bend_angle_deg for frame in frames(asked)]
    return np.array(estimates[8:]) - asked[8:]


before = errors()
known = [0.0] * 8 + [a for a in KNOWN for _ in range(4)]
said = pipeline.calibrate(frames(known), known)
after = errors()
rms = [float(np.sqrt(np.mean(e**2))) for e in (before, after)]
print(f"rms error of the angle: {rms[0]:.2f} deg before, {rms[1]:.2f} deg after")
print(f"standard errors promised at 50 deg: {said.error_before_deg[-1]:.1f} and "
      f"{said.error_after_deg[-1]:.2f} deg")  # fmt: skip
assert rms[0] > 1.0
assert rms[1] < 0.6 * rms[0]

if wanted():
    drawn, axes = figure(1, 1, (7.2, 2.8))
    axes.axhline(0.0, color=PALE, lw=2, zorder=0)
    for found, name, colour in ((before, "pretrained", ORANGE), (after, "calibrated", TEAL)):
        label = f"{name}, rms {np.sqrt(np.mean(found**2)):.2f} deg"
        axes.plot(asked[8:], found, "o-", color=colour, ms=4, label=label)
    axes.plot(KNOWN, [0] * 5, "|", color=GREY, ms=9, label="known angles")
    axes.set(xlabel="true angle [deg]", ylabel="error [deg]")
    axes.set_title("bend angle of one sensor")
    axes.legend()
    save(drawn, __file__)
