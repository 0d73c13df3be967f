"""Rate, latency and cost of live ROS 2 topics.

Run by `python -m eitskin.benchmarks.studies.boards.ros2_topics [--frames N]`, with cyclonedds.

A node publishes readings at several rates, over the loopback interface, to a subscriber in a
process of its own that hears all topics and, for the last row, is stopped. Prints the time from
publishing to hearing, and the processor time that a reading costs the live loop.
"""

import argparse
import json
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from eitskin.frame import Frame
from eitskin.hardware.live import Reading
from eitskin.hardware.ros2.names import dds_topic
from eitskin.hardware.ros2.skin_node import SkinNode
from eitskin.provenance import Provenance
from eitskin.training.pipeline.pipeline import Pipeline

if TYPE_CHECKING:
    from multiprocessing.connection import Connection as Pipe

LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo' multicast='true'/>"
    "</Interfaces></General><Discovery><Tag>ros2_topics</Tag></Discovery></Domain></CycloneDDS>"
)
RATES = {"3.37 per second": 3.37, "30 per second": 30.0, "200 per second": 200.0}
LAST = "/diagnostics"  # topic that a reading publishes last
WARM = 5  # frames that are heard before those that are timed


def hear(path: "Pipe") -> None:
    """Send the number and time [ns] of each reading whose last message came, and count all."""
    from cyclonedds.core import ReadCondition, ViewState, WaitSet
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration

    from eitskin.hardware.export.ros_messages import RosMessages
    from eitskin.hardware.ros2.dds_types import DdsTypes

    messages = RosMessages()
    participant, types = DomainParticipant(0), DdsTypes(messages.store)
    waits = WaitSet(participant)
    profile = Qos(
        Policy.Reliability.Reliable(duration(seconds=1)),
        Policy.History.KeepLast(10),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )
    readers = {}
    for topic, kind in messages.types.items():
        described = Topic(participant, dds_topic(topic), types.of(kind))
        readers[topic] = DataReader(participant, described, qos=profile)
        waits.attach(ReadCondition(readers[topic], ViewState.Any))
    count = 0
    while True:
        waits.wait(duration(seconds=10))
        now = time.time_ns()
        for topic, reader in readers.items():
            for sample in reader.take(100):
                count += 1
                if topic == LAST:
                    values = {pair.key: pair.value for pair in sample.status[0].values}
                    path.send((int(values["session"]), int(values["number"]), now, count))


def readings(count: int) -> list[Reading]:
    """Readings of the shipped pipeline, of a touched and bent frame that it knows."""
    pipeline = Pipeline.load("reference.eitmodel")
    known = pipeline.examples
    flat = known.flat[2]
    frames = [flat, *(flat * (1.0 + known.static[2]) for _ in range(count - 1))]
    layout = pipeline.layout
    made = []
    for number, values in enumerate(frames):
        frame = Frame(values, layout.protocol, 0.3 * number, number, frequency=layout.frequency)
        made.append(Reading(frame, pipeline.process(frame), 0.004, 3.37))
    return made


def timed(node: SkinNode, path: "Pipe", rate: float, given: list[Reading], session: int) -> str:
    """Columns of one rate: heard, latency, processor time."""
    sent, cost, never = {}, [], threading.Event()
    for reading in given:
        frame = reading.frame
        numbered = Frame(
            frame.impedance, frame.protocol, frame.time, frame.number, session, frame.frequency
        )
        start = time.process_time()
        sent[frame.number] = time.time_ns()
        node.publish(Reading(numbered, reading.estimate, 0.004, rate))
        cost.append(time.process_time() - start)
        never.wait(1.0 / rate)
    late = []
    while path.poll(1.0):
        of_session, number, now, _ = path.recv()
        if of_session == session:
            late.append(1e-6 * (now - sent[number]))
    spread = "-"
    if late:
        half, most = np.percentile(late, (50, 99))
        spread = f"{half:.2f} ({most:.2f})"
    return f"{len(late)} | {spread} | {1e3 * float(np.median(cost)):.2f}"


def rows(frames: int) -> Iterator[str]:
    """Table of rates and latencies."""
    os.environ["CYCLONEDDS_URI"] = LOOPBACK
    here, there = multiprocessing.get_context("spawn").Pipe()
    made = readings(frames)
    process: Any = multiprocessing.get_context("spawn").Process(target=hear, args=(there,))
    process.start()
    yield "| readings | published | heard | latency, ms: p50 (p99) | processor time, ms: p50 |"
    yield "|---|---|---|---|---|"
    try:
        with SkinNode() as node:
            for _ in range(200):  # until it hears
                node.publish(made[0])
                if here.poll(0.1):
                    break
            timed(node, here, 30.0, made[:WARM], 98)
            for number, (name, rate) in enumerate(RATES.items(), 1):
                yield f"| {name} | {frames} | {timed(node, here, rate, made, number)} |"
            os.kill(process.pid, signal.SIGSTOP)
            columns = timed(node, here, 200.0, made, 99)
            yield f"| 200 per second, subscriber stopped | {frames} | {columns} |"
            yield f"\n{json.dumps({'refused': node.refused})}"
    finally:
        process.kill()
        process.join()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=100)
    given = parser.parse_args()
    for line in rows(given.frames):
        print(line, flush=True)
    print(f"\nMeasured on {Provenance.now(0)}")


if __name__ == "__main__":
    main()
