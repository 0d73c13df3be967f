"""Run of `bench transfer`: every pipeline in every world, by the number of known angles."""

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from eitskin.benchmarks.paper.sets import Progress
from eitskin.benchmarks.transfer.scores import Figures, scores
from eitskin.benchmarks.transfer.worlds import make
from eitskin.provenance import Provenance
from eitskin.training.pipeline.pipeline import Pipeline

ANGLES = (0, 1, 5)
"""Numbers of known angles that a sensor is calibrated with."""


@dataclass(frozen=True, slots=True)
class Row:
    """Figures of one pipeline in one world after some known angles."""

    pipeline: str
    world: str
    angles: int
    figures: Figures


@dataclass(frozen=True, slots=True)
class Transfer:
    """Everything that was measured.

    Attributes:
        provenance: of the measurement.
        seconds: that the run took [s], less where frames were kept from an earlier one.
        quick: whether fewer sensors had to do.
        rows: one for each pipeline, world and number of known angles.
    """

    provenance: Provenance
    seconds: float
    quick: bool
    rows: tuple[Row, ...]


def run(
    pipelines: Mapping[str, Path],
    folder: Path,
    seed: int,
    quick: bool,
    workers: int,
    progress: Progress,
) -> Transfer:
    """Measure pipelines, saved at the paths given, on sensors of every world.

    Raises ConfigurationError where `folder` holds frames of other recipes.
    """
    began = time.perf_counter()
    rows = tuple(_rows(pipelines, folder, seed, quick, workers, progress))
    return Transfer(Provenance.now(seed), time.perf_counter() - began, quick, rows)


def _rows(
    pipelines: Mapping[str, Path],
    folder: Path,
    seed: int,
    quick: bool,
    workers: int,
    progress: Progress,
) -> Iterator[Row]:
    worlds = make(folder, seed, quick, workers, progress)
    total = len(worlds) * len(pipelines)
    for number, (name, path) in enumerate(pipelines.items()):
        pipeline = Pipeline.load(path)
        for place, world in enumerate(worlds):
            progress("scores", number * len(worlds) + place, total)
            for angles in ANGLES:
                yield Row(name, world.name, angles, scores(pipeline, world, angles))
    progress("scores", total, total)
