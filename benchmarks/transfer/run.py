"""Run of `bench transfer`: every pipeline in every world, by the labelled frames."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from eitskin.benchmarks.paper.sets import Progress
from eitskin.benchmarks.transfer.bounds import bounds
from eitskin.benchmarks.transfer.scores import Figures, Labelled, scores
from eitskin.benchmarks.transfer.worlds import FEW, World, make, recipes
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
        bounds: Cramer-Rao bounds of the frames of each world.
    """

    provenance: Provenance
    seconds: float
    quick: bool
    rows: tuple[Row, ...]
    bounds: Mapping[str, Figures]


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
    worlds = make(folder, seed, quick, workers, progress)
    limits = {
        world.name: bounds(world, recipes(world.name, seed, quick)[0], progress)
        for world in worlds
        if world.name not in FEW
    }
    rows = tuple(_rows(pipelines, worlds, progress))
    return Transfer(Provenance.now(seed), time.perf_counter() - began, quick, rows, limits)


def _rows(
    pipelines: Mapping[str, Path], worlds: Sequence[World], progress: Progress
) -> Iterator[Row]:
    total = len(worlds) * len(pipelines)
    for number, (name, path) in enumerate(pipelines.items()):
        pipeline = Pipeline.load(path)
        for place, world in enumerate(worlds):
            progress("scores", number * len(worlds) + place, total)
            for labelled in LABELLED:
                if labelled.presses and world.name in FEW:
                    continue
                yield Row(name, world.name, labelled, scores(pipeline, world, labelled))
    progress("scores", total, total)
