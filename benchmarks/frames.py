"""Frames that benchmarks make and keep, and the time that a pipeline takes for each."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.results import Progress
from eitskin.datasets import Dataset, Recipe, generate, open_dataset
from eitskin.training import Pipeline


def generate_missing(
    recipe: Recipe, folder: Path, workers: int, progress: Progress, part: str
) -> Dataset:
    """Generate the frames of a recipe that `folder` does not have yet, and open all.

    Progress is of a `part`. Raises ConfigurationError where `folder` holds another recipe's.
    """
    resume = (folder / "recipe.toml").is_file()
    generate(recipe, folder, workers, partial(progress, part), resume=resume)
    return open_dataset(folder)


def frame_times(
    pipeline: Pipeline,
    data: Dataset,
    rows: Sequence[int],
    clock: Callable[[], float] = time.perf_counter,
) -> NDArray[np.float64]:
    """Time [s] of `process` for each of the frames in `rows`, after its two references."""
    seconds, template = np.zeros(len(rows)), data.frame(0)
    for number, row in enumerate(rows):
        pipeline.reset()
        flat, free = data.reference[data.specimen[row]], data.touch_reference[row]
        for n, values in enumerate((flat, free, data.impedance[row])):
            impedance = values.astype(np.complex128)
            frame = replace(template, impedance=impedance, time=0.3 * n, number=n)
            start = clock()
            pipeline.process(frame)
            seconds[number] = clock() - start
    pipeline.reset()
    return seconds
