"""Errors of each term of the instrument model.

Run by `python -m eitskin.benchmarks.studies.boards.instrument`.

Prints, as Markdown, the error of each term alone on the 28 values of the reference sensor, and what
is left of it in the signals of 10 N presses at the paper's 27 positions.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.studies.physics.signals import POSITIONS
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.provenance import Provenance
from eitskin.simulator.instrument.ad5940 import MEASUREMENT_TIME, drive_current, pga_range
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.scene.touch import Touch
from eitskin.simulator.simulator import Simulator

SEED = 0
SESSIONS = 2000
AGE = 4 * 3600.0
"""Of the reference frame, when a press is measured [s]."""
BEND_SPEED_DEG = 10.0
"""Of the scene that the scan is too slow for [deg/s]."""

BOARD = Instrument.ad5940()


def _alone(**terms: float | tuple[float, float]) -> Instrument:
    return dataclasses.replace(Instrument(snr_db=0.0), **terms)  # type: ignore[arg-type]


TERMS = {
    "white noise": ("75 dB", _alone(snr_db=BOARD.snr_db)),
    "floor": ("1.9 uV", _alone(floor=BOARD.floor)),
    "drift, electronics": ("0.2 % in 4 h", _alone(drift=BOARD.drift)),
    "drift, gel": ("off; here 1 % in 4 h", _alone(gel_drift=0.01)),
    "gain": ("sd 0.2 %", _alone(gain=BOARD.gain)),
    "phase": ("sd 0.1 deg", _alone(phase_deg=BOARD.phase_deg)),
    "reciprocity": ("0.4 %", _alone(reciprocity=BOARD.reciprocity)),
    "quantisation": ("18 bits", _alone(quantisation=True)),
    "clipping": ("auto-ranged", _alone(clipping=True)),
    "floor and 18 bits": (
        "with 15 mV",
        _alone(floor=BOARD.floor, quantisation=True, excitation=0.015),
    ),
    "stray capacitance": ("40 to 100 pF", _alone(stray_capacitance=BOARD.stray_capacitance)),
    "all of `Instrument.ad5940()`": ("", BOARD),
}

Complex = NDArray[np.complex128]


@dataclass(frozen=True, slots=True)
class Effect:
    """Root mean squares over sessions, pairs and presses.

    Attributes:
        value: error of the real part of a value, relative [%].
        phase: error of the phase of a value [deg].
        signal: error of a press's signal, the relative change of the real part from a reference
            frame of the same session that is `AGE` old [%].
        flagged: share of the values with a status [%].
    """

    value: float
    phase: float
    signal: float
    flagged: float


def effect(
    instrument: Instrument,
    sim: Simulator,
    flat: Complex,
    pressed: Complex,
    sessions: int = SESSIONS,
) -> Effect:
    """Effect of an instrument on the flat frame (pairs,) and pressed frames (presses, pairs)."""
    truth = pressed.real / flat.real - 1.0
    frames = np.concatenate((flat[None], pressed))
    times = np.array([0.0] + [AGE] * len(pressed))
    errors: dict[str, list[NDArray[np.float64]]] = {"value": [], "phase": [], "signal": []}
    flagged = []
    for start in np.random.default_rng(SEED).spawn(sessions):
        session = instrument.session(sim.protocol, sim.full_scale, start)
        Z, status = session.measure(frames, times, start)
        errors["value"].append(100.0 * (Z.real / frames.real - 1.0))
        errors["phase"].append(np.angle(Z / frames, deg=True))
        errors["signal"].append(100.0 * (Z[1:].real / Z[0].real - 1.0 - truth))
        flagged.append(100.0 * np.mean(status > 0))
    rms = {name: float(np.sqrt(np.mean(np.square(each)))) for name, each in errors.items()}
    return Effect(**rms, flagged=float(np.mean(flagged)))


def skew(sim: Simulator, flat: Complex) -> float:
    """Largest error of a value, relative [%], because it is read later than its frame began."""
    period = MEASUREMENT_TIME * len(flat)
    after = sim.measure(Scene(Bend(BEND_SPEED_DEG * period))).impedance
    late = BOARD.offsets(sim.protocol) / period * (after - flat)
    return float(np.abs(100.0 * late / flat).max())


def main() -> None:
    """Print the tables."""
    sim = Simulator(SensorDesign.reference())
    flat = sim.measure(Scene()).impedance
    scenes = [Scene(touches=(Touch(x, y, 10.0),)) for x, y in POSITIONS]
    pressed = sim.measure_all(scenes)
    strongest = 100.0 * np.abs(pressed.real / flat.real - 1.0).max(axis=1)
    through = drive_current(flat, flat, BOARD.rtia)
    print(Provenance.now(SEED), "\n")
    print(f"- values [ohm]: {np.abs(flat).min():.0f} to {np.abs(flat).max():.0f}")
    milliamperes = 1e3 * np.abs(through)
    print(f"- current, auto-ranged [mA]: {milliamperes.min():.2f} to {milliamperes.max():.2f}")
    print(f"- ranges of the voltage [V]: {np.unique(pga_range(through * flat))}")
    print(f"- ranges of the current [V]: {np.unique(pga_range(through * BOARD.rtia))}")
    print(f"- signal of the strongest pair [%]: {strongest.min():.2f} to {strongest.max():.2f}\n")
    print("| term | default | value, % | phase, deg | signal, % | flagged, % |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name, (text, instrument) in TERMS.items():
        found = dataclasses.astuple(effect(instrument, sim, flat, pressed))
        # Residuals below rounding count as zero.
        cells = (f"{number:.2g}" if number > 1e-12 else "0" for number in found)
        print(f"| {name} | {text} | {' | '.join(cells)} |")
    print(f"\n- skew at {BEND_SPEED_DEG:g} deg/s of bend, at most [%]: {skew(sim, flat):.2f}")


if __name__ == "__main__":
    main()
