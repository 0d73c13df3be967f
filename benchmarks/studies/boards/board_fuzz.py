"""Damage on the line between board and host.

Run by `python -m eitskin.benchmarks.studies.boards.board_fuzz`.

Feeds the codec random and mutated bytes, strikes a virtual board with every fault at random times,
and pulls and puts back its cable many times. A board of 32 electrodes, whose frames of 928
measurements take nine packets, is struck with the faults of the line. Prints a report as Markdown.
"""

import argparse
import itertools
import os
import random
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from eitskin.benchmarks.studies.boards.fuzz_codec import fuzz_codec
from eitskin.errors import DeviceError
from eitskin.frame import Frame
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.hardware.boards.board import Board
from eitskin.hardware.boards.connection import Connection
from eitskin.hardware.virtual.fault import Fault, Hook
from eitskin.hardware.virtual.fault_table import FAULTS, SENSOR_FAULTS
from eitskin.hardware.virtual.line_faults import DAMAGE_FAULTS, WIRE_FAULTS
from eitskin.hardware.virtual.scene_script import SceneSource
from eitskin.hardware.virtual.simulated_sensor import SceneSolver
from eitskin.hardware.virtual.virtual_board import VirtualBoard, open_virtual
from eitskin.protocol import Protocol
from eitskin.provenance import Provenance
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.simulator import Simulator

PERIOD = 0.02  # s, from frame to frame while faults strike
FRAMES = 15  # that each board is asked for after a fault
MEETING = (
    "wrong_count",
    "wrong_table",
    "already_streaming",
    "port_in_use",
    "no_reply",
    "late_reply",
    "negative_ack",
)
"""Faults of meeting a board; they strike when it comes back, so the cable is pulled too."""
REFUSED = {"wrong_table": "expected board"}
"""What must end in an error for good, and how that begins."""


LARGE = (*WIRE_FAULTS, "reboot", "counter_wrap", "unplug_mid_frame", "replug")
"""Faults that strike the board of large frames."""


class LargeSensor:
    """Sensor of 32 electrodes whose frames of 928 measurements are multiples of the flat one.

    Attributes:
        protocol: adjacent drive and sense pairs.
    """

    protocol = Protocol.adjacent(32)

    def __init__(self) -> None:
        """Draw the flat sensor's impedance matrix."""
        root = np.random.default_rng(0).standard_normal((32, 32))
        self._flat = root @ root.T

    def impedance_matrix(self, scene: Scene) -> np.ndarray:
        """Impedance matrix of a scene [ohm]; each degree of bend adds the flat one once more."""
        matrix: np.ndarray = self._flat * (1.0 + scene.bend.angle_deg)
        return matrix


@dataclass
class Struck:
    """Frames and errors at the host under one fault at many random times.

    Attributes:
        rounds: how often it struck.
        frames: that came after the fault was injected.
        lost, dropped, reconnections: as the board counted them.
        sessions: that began.
        false: frames that are none of the sensor's, or whose number is not above the last.
        refused: rounds that ended in the error that they should end in.
        raised: all other exceptions, by name.
    """

    rounds: int = 0
    refused: int = 0
    frames: int = 0
    lost: int = 0
    dropped: int = 0
    reconnections: int = 0
    sessions: int = 0
    false: int = 0
    raised: Counter[str] = field(default_factory=Counter)


def strike(
    name: str,
    rounds: int,
    seed: int,
    sensor: SceneSolver,
    scenes: SceneSource = lambda _: Scene(),
) -> Struck:
    """Inject a fault at random times into a board that streams through a pseudo-terminal."""
    rng = random.Random(f"{seed}{name}")  # noqa: S311
    found = Struck()
    flat = sensor.protocol.measure(sensor.impedance_matrix(Scene()))
    for _ in range(rounds):
        found.rounds += 1
        try:
            with open_virtual(simulator=sensor, period=PERIOD, snr_db=75.0, scene=scenes) as board:
                frames = _struck_frames(board, name, rng)
                _judge(frames, flat, name, found)
                _count(board, found)
        except DeviceError as error:
            expected = name in REFUSED and REFUSED[name] in str(error)
            found.refused += expected
            found.raised[f"DeviceError: {error}"] += not expected
        except Exception as error:  # whatever comes is what is looked for
            found.raised[type(error).__name__] += 1
    return found


def _struck_frames(board: VirtualBoard, name: str, rng: random.Random) -> list[Frame]:
    """Frames of a board in which the fault strikes after some of them."""
    stage = board.stage
    away = 0

    def wait(seconds: float) -> None:
        nonlocal away
        away += 1
        if away >= (20 if name in MEETING else 2):
            stage.clear()
        time.sleep(min(seconds, 0.02))

    frames = Connection(board, wait=wait).frames()
    before = list(itertools.islice(frames, rng.randrange(1, 20)))
    indices = 2400 if name in DAMAGE_FAULTS else 28 if name in SENSOR_FAULTS else 3
    fault = f"{name}:{rng.randrange(indices)}"
    stage.inject(f"{fault}, replug" if name in MEETING else fault)
    return before + list(itertools.islice(frames, FRAMES))


def _judge(frames: list[Frame], flat: np.ndarray, name: str, found: Struck) -> None:
    found.frames += len(frames)
    found.sessions += len({frame.session for frame in frames}) - 1
    for last, frame in itertools.pairwise(frames):
        step = (frame.number - last.number) % 2**32
        if last.session == frame.session and not 0 < step < 2**31:
            found.false += 1
        if name in SENSOR_FAULTS:
            continue
        # Frames of a `LargeSensor` are whole multiples of the flat one; others are the flat one.
        times = np.round(np.vdot(flat, frame.impedance).real / np.vdot(flat, flat).real)
        error = np.abs(frame.impedance - times * flat)
        right = bool((error <= 5e-3 * times * np.abs(flat).max()).all())
        found.false += not right


def _count(board: Board, found: Struck) -> None:
    counts = board.counts
    found.lost += counts.lost
    found.dropped += sum(counts.dropped.values())
    found.reconnections += counts.reconnections


@dataclass
class Cable:
    """Effect of pulling and putting back the cable; times in s.

    Attributes:
        noticed: from pulling until the host knew, of each round.
        back: from pulling until a frame of the new session, of each round.
        before, after: open files, threads and resident memory [MiB].
    """

    noticed: list[float] = field(default_factory=list)
    back: list[float] = field(default_factory=list)
    before: tuple[int, int, float] = (0, 0, 0.0)
    after: tuple[int, int, float] = (0, 0, 0.0)


def replug(rounds: int, sensor: Simulator) -> Cable:
    """Pull and put back the cable of a board of 30 frames per second."""
    found = Cable()
    with open_virtual(simulator=sensor, period=1 / 30) as board:
        stage = board.stage
        waiting: list[float] = []

        def wait(seconds: float) -> None:
            waiting.append(time.perf_counter())
            time.sleep(min(seconds, 0.05))

        frames = Connection(board, wait=wait).frames()
        for round_ in range(-5, rounds):  # the first are for what is loaded once
            if round_ == 0:
                found.before = _holdings()
            session = next(frames).session
            waiting.clear()
            pulled: list[float] = []
            stage.inject([timed_replug(pulled)])
            while next(frames).session == session:
                pass
            if round_ >= 0:
                found.back.append(time.perf_counter() - pulled[0])
                found.noticed.append(waiting[0] - pulled[0])
        found.after = _holdings()
    return found


def timed_replug(pulled: list[float]) -> Fault:
    """A replug that appends the time at which the cable is pulled to `pulled` [s]."""
    kind = FAULTS["replug"]

    def packet(whole: bytes, fault: Fault) -> Any:
        if fault.since == 0:
            pulled.append(time.perf_counter())
        return kind.effects[Hook.PACKET](whole, fault)

    return Fault("replug", replace(kind, effects={Hook.PACKET: packet}), kind.frame)


def _holdings() -> tuple[int, int, float]:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    files = len(list(Path("/proc/self/fd").iterdir()))
    return files, threading.active_count(), pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def _struck_table(
    title: str, names: Iterable[str], struck: Callable[[str], Struck]
) -> Iterator[str]:
    columns = "rounds", "frames", "lost", "dropped", "reconnections", "new sessions", "false"
    yield f"| {title} | {' | '.join(columns)} | exceptions |"
    yield "|---" * (len(columns) + 2) + "|"
    for name in names:
        got = struck(name)
        raised = ", ".join(f"{count} {what}" for what, count in got.raised.items() if count)
        raised = raised or (f"none; refused in {got.refused}" if got.refused else "none")
        yield (
            f"| {name} | {got.rounds} | {got.frames} | {got.lost} | {got.dropped} | "
            f"{got.reconnections} | {got.sessions} | {got.false} | {raised} |"
        )


def report(total: int, rounds: int, cables: int, seed: int) -> Iterator[str]:
    """Lines of the report, as they are known."""
    yield f"Measured on {Provenance.now(seed)}\n"
    began = time.perf_counter()
    codec = fuzz_codec(total, seed)
    yield "| the codec | |\n|---|---|"
    yield f"| random and mutated bytes fed | {codec.fed:,} |"
    yield f"| exceptions | {codec.raised.total()} |"
    yield f"| frames that came out whole | {codec.whole:,} |"
    yield f"| packets that came out and had not been sent | {codec.false} |"
    yield f"| most bytes held back | {codec.longest} |"
    yield f"| frames of several packets that came out whole | {codec.joined:,} |"
    yield f"| frames of several packets that came out and had not been sent | {codec.mixed} |"
    for good, count in sorted(codec.regained.items()):
        yield f"| after damage, good frames until one came out: {good} | {count:,} times |"
    yield f"| dropped | {', '.join(f'{n:,} {reason}' for reason, n in codec.drops.items())} |"
    yield f"| time | {time.perf_counter() - began:.0f} s |\n"
    sensor = Simulator(SensorDesign.reference(), resolution="fast")
    yield from _struck_table("fault", FAULTS, lambda name: strike(name, rounds, seed, sensor))
    yield "\n**928 measurements**\n"
    large, bends = LargeSensor(), [Scene(bend=Bend(float(angle))) for angle in range(50)]
    yield from _struck_table(
        "fault",
        LARGE,
        lambda name: strike(name, rounds, seed, large, lambda now: bends[now % len(bends)]),
    )
    cable = replug(cables, sensor)
    yield f"\n| the cable, pulled and put back {cables} times | |\n|---|---|"
    for label, times in (("noticed", cable.noticed), ("frames again", cable.back)):
        half, most = 1e3 * np.median(times), 1e3 * max(times)
        yield f"| {label} after, median and longest | {half:.1f}, {most:.1f} ms |"
    for label, first, last in zip(
        ("open files", "threads", "resident memory, MiB"), cable.before, cable.after, strict=True
    ):
        yield f"| {label}, before and after | {first:.4g}, {last:.4g} |"


def main() -> None:
    """Print the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bytes", type=int, default=10_000_000)
    parser.add_argument("--rounds", type=int, default=20, help="of each fault")
    parser.add_argument("--cables", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    for line in report(given.bytes, given.rounds, given.cables, given.seed):
        print(line, flush=True)


if __name__ == "__main__":
    main()
