"""Rate and latency of the live loop.

Run by `python -m eitskin.benchmarks.studies.boards.live_rate`.

Frames cross a pseudo-terminal as packets, from a board in a process of its own, and go through the
pipeline that ships. Prints frames per second and the time of each stage, for boards as fast as they
are read and for paced ones.
"""

import argparse
import contextlib
import multiprocessing
import time
from collections.abc import Iterator, MutableSequence
from typing import TYPE_CHECKING, Any

import numpy as np

from eitskin.benchmarks.speed.scenes import LIVE_SCENES
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.hardware.boards.board import Board
from eitskin.hardware.opening import open_board
from eitskin.hardware.protocol.packets import Decoder
from eitskin.hardware.virtual.fault import Fault, FaultKind, Hook
from eitskin.hardware.virtual.scene_script import Script, Step
from eitskin.hardware.virtual.virtual_board import virtual_terminal
from eitskin.provenance import Provenance
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.simulator import Simulator

if TYPE_CHECKING:
    from multiprocessing.connection import Connection as Pipe

    from eitskin.training.pipeline.pipeline import Pipeline

PAPER_MS = 606.6
MIXED = """
[[steps]]
frames = 20
[steps.scene]
[[steps]]
frames = 20
[steps.scene.bend]
angle_deg = 20.0
[[steps]]
frames = 20
[steps.scene]
bend = { angle_deg = 20.0 }
touches = [{ x = 0.030, y = 0.040 }, { x = 0.075, y = 0.018 }]
[[steps]]
frames = 20
[steps.scene]
touches = [{ x = 0.025, y = 0.018 }, { x = 0.050, y = 0.042 }, { x = 0.100, y = 0.042 }]
"""
"""All states in turn, for a session that goes on for hours."""
BOARDS: dict[str, dict[str, Any]] = {
    "as fast as it is read": {"speed": "max", "period": 0.01},
    "30 per second": {"speed": "real", "period": 1 / 30},
    "the AD5940's, 3.37 per second": {"speed": "real", "period": None},
}
STAGES = ("line and codec", "pipeline")


def frame_clock(times: "MutableSequence[float]") -> Fault:
    """Fault without effect that notes the time [s] at which each frame goes to the line."""

    def packet(whole: bytes, fault: Fault) -> bytes:
        times[(fault.frame + fault.since) % len(times)] = time.perf_counter()
        return whole

    return Fault("frame clock", FaultKind("Frames are timed.", {Hook.PACKET: packet}), 0)


def serve(path: "Pipe", times: "MutableSequence[float]", options: dict[str, Any]) -> None:
    """Serve a virtual board in a process of its own, as a real board is none of the host's."""
    with contextlib.suppress(KeyboardInterrupt):
        terminal = virtual_terminal(**options)
        terminal.firmware.stage.inject([frame_clock(times)])
        path.send(terminal.path)
        terminal.serve()


@contextlib.contextmanager
def apart(**options: Any) -> "Iterator[tuple[Board, MutableSequence[float]]]":
    """Context of a virtual board in another process, and the times it sent each frame."""
    context = multiprocessing.get_context("spawn")
    times = context.Array("d", 4096, lock=False)
    here, there = context.Pipe()
    process = context.Process(target=serve, args=(there, times, options), daemon=True)
    process.start()
    try:
        with open_board(f"serial:{here.recv()}") as board:
            yield board, times
    finally:
        process.kill()
        process.join()


def staged(
    board: Board, times: "MutableSequence[float]", pipeline: "Pipeline", frames: int
) -> np.ndarray:
    """Seconds of each stage for so many frames, and when each was done, (frames, stages + 1)."""
    rows = []
    for frame in board.frames():
        came = time.perf_counter()
        pipeline.process(frame)
        done = time.perf_counter()
        sent = times[frame.number % len(times)]
        rows.append((came - sent, done - came, done))
        if len(rows) == frames:
            break
    return np.array(rows)


def rates(frames: int, seed: int) -> Iterator[str]:
    """Tables of rates and stages, as Markdown."""
    from eitskin.training.pipeline.pipeline import Pipeline

    pipeline = Pipeline.load("reference.eitmodel")
    stages = " | ".join(f"{stage}, ms: p50 (p99)" for stage in STAGES)
    yield f"| board | scene | frames/s | CPU, % of a core | {stages} |"
    yield "|---" * (4 + len(STAGES)) + "|"
    for name, options in BOARDS.items():
        count = frames if options["period"] else frames // 20
        for scene_name, scene in LIVE_SCENES.items():
            script = Script((Step(Scene(), 12), Step(scene, 1)), repeat=False)
            settings = {"scene": script, "seed": seed, "instrument": "ad5940", **options}
            with apart(**settings) as (board, times):
                pipeline.reset()
                cpu, began = time.process_time(), time.perf_counter()
                rows = staged(board, times, pipeline, count)[min(20, count // 2) :]
                busy = (time.process_time() - cpu) / (time.perf_counter() - began)
            rate = (len(rows) - 1) / (rows[-1, 2] - rows[0, 2])
            half, most = np.percentile(1e3 * rows[:, :2], (50, 99), axis=0)
            shown = [f"{a:.2f} ({b:.2f})" for a, b in zip(half, most, strict=True)]
            if options["speed"] == "max":
                shown[0] = "full queue"
            yield (
                f"| {name} | {scene_name} | {rate:.1f} | {100 * busy:.0f} | {' | '.join(shown)} |"
            )
    yield f"\nThe paper's frame takes {PAPER_MS} ms, 303 of them for its acquisition.\n"
    yield f"- codec alone, decoded from bytes in memory, frames per second: {codec_rate():,.0f}"


def codec_rate(frames: int = 20000) -> float:
    """Frames per second that the codec decodes."""
    from eitskin.hardware.protocol.messages import unpack

    with virtual_terminal(simulator=Simulator(SensorDesign.reference(), resolution="fast")) as t:
        packet = t.firmware.frame()
    data = packet * frames
    began = time.perf_counter()
    decoder, count = Decoder(), 0
    for start in range(0, len(data), 4096):
        for each in decoder.feed(data[start : start + 4096]):
            unpack(each)
            count += 1
    assert count == frames  # noqa: S101
    return count / (time.perf_counter() - began)


def main() -> None:
    """Print the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=600, help="of each board and scene")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    print(f"Measured on {Provenance.now(given.seed)}\n")
    for line in rates(given.frames, given.seed):
        print(line, flush=True)


if __name__ == "__main__":
    main()
