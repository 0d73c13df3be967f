"""False and missed alarms of the sensor check.

Run by `python -m eitskin.benchmarks.studies.boards.sensor_check`.

Prints, as Markdown, how many healthy specimens of the recipe `training` it accuses, and of each
fault, injected at every place where it can be, how often it is named with its place, and how often
with nothing else beside it. Takes a few minutes.
"""

import argparse
import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.studies.physics.signals import POSITIONS
from eitskin.datasets.recipe.frame_sampling import specimen
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.frame import Frame, Status
from eitskin.hardware.diagnosis.finding import FindingKind
from eitskin.hardware.diagnosis.sensor_check import SensorCheck, check_sensor
from eitskin.protocol import Protocol
from eitskin.provenance import Provenance
from eitskin.simulator.instrument.ad5940 import MEASUREMENT_TIME
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.scene.touch import Touch
from eitskin.simulator.simulator import Simulator
from eitskin.training.pipeline.pipeline import Pipeline
from eitskin.training.pipeline.saved_form import SHIPPED

FRAMES = 16
STRAY = -39.8e3j
"""What an open lead measures: 100 pF at 40 kHz [ohm]."""
SERIES = (60.0, 100.0, 150.0, 300.0, 2000.0)
"""Of bad contacts [ohm]; a good one has about 60."""
FORCE = 6.0
"""Of a touch during the check, half of the range that `training` presses with [N]."""

Complex = NDArray[np.complex128]
PROTOCOL = Protocol.pairwise(8)
PAIRS = tuple(itertools.combinations(range(8), 2))


@dataclass(frozen=True, slots=True, eq=False)
class FaultCase:
    """Frames with one fault.

    Attributes:
        name: of the fault.
        what: must be found.
        electrodes, channels: where, those that are not empty.
        truth: noise-free impedances, (frames, pairs) [ohm].
        status: (frames, pairs).
        after: what the board does to the values.
        factor: that it gets them wrong by.
    """

    name: str
    what: FindingKind
    truth: Complex
    electrodes: tuple[int, ...] = ()
    channels: tuple[int, ...] = ()
    status: NDArray[np.uint8] | None = None
    after: str = ""
    factor: float = 1.0

    def named(self, check: SensorCheck) -> bool:
        """Whether the fault is among the findings, at its place."""
        return any(self._is(each.what, each.electrodes, each.channels) for each in check.findings)

    def alone(self, check: SensorCheck) -> bool:
        """Whether the fault is the only finding."""
        return self.named(check) and len(check.findings) == 1

    def _is(
        self, what: FindingKind, electrodes: tuple[int, ...], channels: tuple[int, ...]
    ) -> bool:
        same = what == self.what and electrodes == self.electrodes
        return same and (not self.channels or channels == self.channels)


def touching(electrode: int) -> NDArray[np.bool_]:
    """Pairs that an electrode takes part in."""
    return np.array([electrode in pair for pair in PAIRS])


def shorted(flat: Complex, pair: tuple[int, int], wire: float = 0.5) -> Complex:
    """Pairwise impedances when `wire` [ohm] joins two electrodes.

    Pairwise resistances R fix the impedance matrix Z = -(1/2) C R C, with C the centring matrix;
    by Sherman and Morrison it loses Z e e^T Z / (wire + e^T Z e), with e = 1 at one, -1 at the
    other electrode.
    """
    R = np.zeros((8, 8), dtype=complex)
    for (a, b), value in zip(PAIRS, flat, strict=True):
        R[a, b] = R[b, a] = value
    C = np.eye(8) - 1.0 / 8.0
    Z = -0.5 * C @ R @ C
    difference = Z[:, pair[0]] - Z[:, pair[1]]
    Z = Z - np.outer(difference, difference) / (wire + difference[pair[0]] - difference[pair[1]])
    return PROTOCOL.measure(Z).astype(complex)


def cases(flat: Complex, pressed: Complex, rng: np.random.Generator) -> Iterator[FaultCase]:
    """Cases of every fault at every position, on a sensor of noise-free values (pairs,)."""
    still = np.repeat(flat[None], FRAMES, axis=0)
    for e in range(8):
        yield from _at_electrode(still, e)
    for k, pair in enumerate(PAIRS):
        a, b = pair
        turned = {a: b, b: a}
        order = [PAIRS.index(tuple(sorted(turned.get(e, e) for e in each))) for each in PAIRS]
        yield FaultCase("swapped electrodes", FindingKind.SWAPPED, still[:, order], pair)
        joined = np.repeat(shorted(flat, pair)[None], FRAMES, axis=0)
        yield FaultCase("shorted pair", FindingKind.SHORT, joined, pair)
        yield from _at_channel(still, k, rng)
    for factor in (0.2, 5.0, 50.0):
        yield FaultCase("wrong RTIA or RCAL", FindingKind.FACTOR, still, factor=factor)
    yield FaultCase("phase off by 30 deg", FindingKind.PHASE, still * np.exp(1j * np.deg2rad(30.0)))
    yield FaultCase("frozen", FindingKind.FROZEN, still, after="frozen")
    for each in pressed:
        moved = still.copy()
        moved[FRAMES // 2 :] *= each
        yield FaultCase(f"touched with {FORCE:g} N half-way", FindingKind.MOVED, moved)


def _at_electrode(still: Complex, e: int) -> Iterator[FaultCase]:
    opened, status = still.copy(), np.zeros(still.shape, np.uint8)
    opened[:, touching(e)] = STRAY
    yield FaultCase("open electrode, not marked", FindingKind.OPEN, opened, (e,))
    status[:, touching(e)] = Status.OPEN
    yield FaultCase("open electrode, marked", FindingKind.OPEN, opened, (e,), status=status)
    for ohm in SERIES:
        worse = still + ohm * touching(e)
        yield FaultCase(f"bad contact, {ohm:g} ohm", FindingKind.BAD_CONTACT, worse, (e,))


def _at_channel(still: Complex, k: int, rng: np.random.Generator) -> Iterator[FaultCase]:
    one = np.arange(len(PAIRS)) == k
    status = np.zeros(still.shape, np.uint8)
    status[:, k] = Status.CLIPPED
    yield FaultCase("stuck channel", FindingKind.STUCK, still, channels=(k,), after="stuck")
    yield FaultCase(
        "channel not finite", FindingKind.NOT_FINITE, still, channels=(k,), after="not finite"
    )
    yield FaultCase(
        "clipped channel", FindingKind.CLIPPED, still * (1 - 0.3 * one), (), (k,), status
    )
    noisy = still * (1 + 0.01 * one * rng.standard_normal(still.shape))
    yield FaultCase("noisy channel, 1 %", FindingKind.NOISY, noisy, channels=(k,))
    yield FaultCase(
        "channel off by 10 %", FindingKind.MISFIT, still * (1 + 0.1 * one), channels=(k,)
    )


def measured(case: FaultCase, rng: np.random.Generator, full_scale: float) -> list[Frame]:
    """Frames of a case as the board gives them."""
    session = Instrument.ad5940().session(PROTOCOL, full_scale, rng)
    times = len(PAIRS) * MEASUREMENT_TIME * np.arange(FRAMES, dtype=np.float64)
    impedance, status = session.measure(case.truth, times, rng)
    impedance = impedance * case.factor
    if case.status is not None:
        status = status | case.status
    if case.after == "frozen":
        impedance[:] = impedance[0]
    elif case.after == "stuck":
        impedance[:, case.channels] = impedance[0, case.channels]
    elif case.after == "not finite":
        impedance[:, case.channels] = complex(np.nan, np.nan)
    return [
        Frame(each, PROTOCOL, time, number, status=bits)
        for number, (each, time, bits) in enumerate(zip(impedance, times, status, strict=True))
    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--specimens", type=int, default=400, help="healthy ones")
    parser.add_argument("--faulty", type=int, default=40, help="that get every fault")
    parser.add_argument("--first", type=int, default=0, help="number of the first specimen")
    parser.add_argument("--seed", type=int, default=0, help="of the boards")
    given = parser.parse_args()
    recipe, rng = Recipe.shipped("training"), np.random.default_rng(given.seed)
    nominal = Simulator(recipe.sensor, recipe.resolution)
    flat = nominal.measure(Scene()).impedance
    scenes = [Scene(touches=(Touch(x, y, FORCE),)) for x, y in POSITIONS]
    pressed = nominal.measure_all(scenes) / flat
    shipped = Pipeline.load(SHIPPED).layout.reference
    accused: dict[str, list[SensorCheck]] = {"the design": [], "the shipped pipeline": []}
    counts: dict[str, list[int]] = {}
    spent = []
    for number in range(given.specimens):
        sim = Simulator(specimen(recipe, given.first + number).design, recipe.resolution)
        own = sim.measure(Scene()).impedance
        still = FaultCase("healthy", FindingKind.MISFIT, np.repeat(own[None], FRAMES, axis=0))
        tried = [still, *(cases(own, pressed, rng) if number < given.faulty else ())]
        for case in tried:
            frames = measured(case, rng, nominal.full_scale)
            begun = time.process_time()
            check = check_sensor(frames, np.abs(flat))
            spent.append(time.process_time() - begun)
            if case is still:
                accused["the design"] += [] if check.healthy else [check]
                check = check_sensor(frames, shipped)
                accused["the shipped pipeline"] += [] if check.healthy else [check]
                continue
            row = counts.setdefault(case.name, [0, 0, 0])
            row[0] += 1
            row[1] += case.named(check)
            row[2] += case.alone(check)
    print(Provenance.now(given.seed), "\n")
    for name, checks in accused.items():
        print(f"- accused of {given.specimens} healthy specimens, expecting {name}: {len(checks)}")
        for check in checks:
            print("  ", "; ".join(each.message for each in check.findings))
    half, most = 1e3 * np.percentile(spent, (50, 99))
    print(f"- check of {FRAMES} frames, median and p99 [ms]: {half:.1f}, {most:.1f}\n")
    print("| fault | cases | named with its place, % | and nothing else, % |")
    print("| --- | --- | --- | --- |")
    for name, (total, named, alone) in counts.items():
        print(f"| {name} | {total} | {100 * named / total:.1f} | {100 * alone / total:.1f} |")


if __name__ == "__main__":
    main()
