"""Run of `bench transfer`: every pipeline in every world, by the labelled frames."""

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from eitskin.benchmarks.paper.sets import Progress
from eitskin.benchmarks.transfer.scores import Figures, Labelled, scores
from eitskin.benchmarks.transfer.worlds import make
from eitskin.provenance import Provenance
from eitskin.training.pipeline.pipeline import Pipeline

LABELLED = tuple(Labelled(*each) for each in ((0, 0), (1, 0), (5, 0), (5, 15), (20, 80)))
"""Labelled frames that a sensor is adapted by."""


@dataclass(frozen=True, slots=True)
class Row:
    """Figures of one pipeline in one world, adapted by some labelled frames."""

    pipeline: str
    world: str
    labelled: Labelled
    figures: Figures


@dataclass(frozen=True, slots=True)
class Transfer:
    """Everything that was measured.

    Attributes:
        provenance: of the measurement.
        seconds: that the run took [s], less where frames were kept from an earlier one.
        quick: whether fewer sensors had to do.
        rows: one for each pipeline, world and number of labelled frames.
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
            for labelled in LABELLED:
                yield Row(name, world.name, labelled, scores(pipeline, world, labelled))
    progress("scores", total, total)
