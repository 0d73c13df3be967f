"""The joint method with many measurements: time of training and of a frame, and errors.

    python -m eitskin.benchmarks.studies.data.many_channels [--whole] [--auto]

Learns from 420 frames of six linear specimens of a disc with 16 electrodes, adjacent (208
measurements), and judges on others. `--whole` also trains without combinations of measurements,
`--auto` also chooses the method as `eitskin train` does. Times are of the processor.
"""

import argparse
import time

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.studies.data.linear_frames import LinearSensors
from eitskin.datasets.store.dataset import Dataset
from eitskin.geometry.design.outline import Disc
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol
from eitskin.provenance import Provenance
from eitskin.training.evaluation.evaluate import Evaluation
from eitskin.training.evaluation.selection import Selection
from eitskin.training.joint import combinations
from eitskin.training.method.observations import Observations
from eitskin.training.method.settings import TrainingSettings
from eitskin.training.pipeline.pipeline import Pipeline

SEED = 3
SPECIMENS, LEARNED = 8, 6  # the others are judged by
IDLE, TOUCHED, MOST_TOUCHES = 180, 240, 3
REPEATS = 3  # of which the least time of a frame counts


def main() -> None:
    """Print a table of the variants asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--whole", action="store_true", help="also without combinations")
    parser.add_argument("--auto", action="store_true", help="also choose the method")
    arguments = parser.parse_args()
    design = SensorDesign(
        outline=Disc(0.06), electrodes=uniform(Disc(0.06), 16, 0.006), thickness=0.004
    )
    sensors = LinearSensors(design, Protocol.adjacent(16), SPECIMENS, SEED)
    learned = sensors.dataset(IDLE, TOUCHED, 0, MOST_TOUCHES, 1)
    judged = sensors.dataset(80, TOUCHED, 0, MOST_TOUCHES, 2)
    learned = learned.select(np.flatnonzero(learned.specimen < LEARNED))
    judged = judged.select(np.flatnonzero(judged.specimen >= LEARNED))
    print("| | training, s | error, mm | found | false | median ms | p99 ms |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    print(row("combinations", learned, judged))
    if arguments.whole:
        combinations.MOST = 0.0
        print(row("each measurement by itself", learned, judged))
    if arguments.auto:
        start = time.process_time()
        chosen = Selection.of(learned)
        print(f"\nauto: {chosen.preset} after {time.process_time() - start:.0f} s")
        for trial in chosen.trials:
            print(trial.as_dict())
    print(f"\n{Provenance.now(SEED)}")


def row(name: str, learned: Dataset, judged: Dataset) -> str:
    """Train the joint method and judge it, as a row of the table."""
    start = time.process_time()
    pipeline = Pipeline.fit(learned, TrainingSettings.preset("joint"))
    seconds = time.process_time() - start
    matches = Evaluation.of(pipeline, judged).matches
    touches, times = int(judged.touch_count.sum()), 1e3 * frame_seconds(pipeline, judged)
    figures = (
        f"{seconds:.0f}",
        f"{1e3 * float(matches.error.mean()):.2f}",
        f"{len(matches.error) / touches:.1%}",
        f"{float(matches.false.sum()) / touches:.1%}",
        f"{np.median(times):.1f}",
        f"{np.percentile(times, 99):.1f}",
    )
    return f"| {name} | " + " | ".join(figures) + " |"


def frame_seconds(pipeline: Pipeline, data: Dataset) -> NDArray[np.float64]:
    """Least processor time (n,) [s] of each frame."""
    observations, seconds = Observations.of(data), np.full(len(data), np.inf)
    for _ in range(REPEATS):
        for i in range(len(data)):
            start = time.process_time()
            pipeline.method.predict(observations[i : i + 1])
            seconds[i] = min(seconds[i], time.process_time() - start)
    return seconds


if __name__ == "__main__":
    main()
