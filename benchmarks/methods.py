"""Methods side by side, on the same frames and the same unseen specimens: `eitskin bench methods`.

The frames are a small part of the recipe `training`, on a coarse mesh. The last row is the pipeline
that comes with eitskin, which has learned from other frames, of 500 other specimens. Times are of
the processor, which other programs do not lengthen.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from eitskin.benchmarks.frames import frame_times, generate_missing
from eitskin.benchmarks.results import Progress, Report, ReportTable, measured
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.store.dataset import Dataset
from eitskin.training.evaluation.evaluate import Evaluation
from eitskin.training.evaluation.selection import Trial
from eitskin.training.method.interface import Method
from eitskin.training.method.settings import BASELINES, TrainingSettings
from eitskin.training.pipeline.pipeline import Pipeline
from eitskin.training.pipeline.saved_form import SHIPPED

FRAMES, SPECIMENS = 2000, 40
QUICK_FRAMES, QUICK_SPECIMENS = 300, 6
TIMED = 100  # frames
_COLUMNS = {
    "states": ("states right, %", 100.0, 1),
    "error_mm": ("touches: error, mm", 1.0, 2),
    "found": ("found, %", 100.0, 1),
    "false_per_touch": ("false, %", 100.0, 1),
    "angle_rmse_deg": ("angle: RMSE, deg", 1.0, 2),
}


def run(
    folder: Path,
    presets: Sequence[str],
    methods: Sequence[type[Method]],
    seed: int,
    quick: bool,
    workers: int,
    progress: Progress,
) -> Report:
    """Train and judge methods.

    Args:
        folder: of the frames, which are kept.
        presets: names of settings; the baselines where nothing is named.
        methods: of one's own.
        seed: of the training.
        quick: fewer frames and specimens.
        workers: processes that make frames.
        progress: told of every part.
    """
    began, place = time.perf_counter(), folder / ("quick-frames" if quick else "frames")
    recipe = small_recipe(*((QUICK_FRAMES, QUICK_SPECIMENS) if quick else (FRAMES, SPECIMENS)))

    data = generate_missing(recipe, place, workers, progress, "frames")
    chosen = presets or (() if methods else BASELINES)
    asked: list[tuple[str, TrainingSettings, type[Method] | None]] = [
        *((name, TrainingSettings.preset(name, seed), None) for name in chosen),
        *((each.KIND, TrainingSettings(seed=seed), each) for each in methods),
    ]
    rows = []
    for number, (name, settings, method) in enumerate(asked):
        progress(name, number, len(asked))
        start = time.process_time()
        pipeline = Pipeline.fit(data, replace(settings, whole_specimens=True), method=method)
        seconds = time.process_time() - start
        unseen = data.select(pipeline.held_out(data))
        rows.append(_row(name, pipeline, unseen, f"{seconds:.1f}"))
    rows.append(_row("shipped", Pipeline.load(SHIPPED), unseen, ""))
    heads = ("", *(head for head, *_ in _COLUMNS.values()), "training, s", "frame, ms")
    shown = ReportTable(heads, rows)
    options = "".join(f" --preset {name}" for name in presets)
    options += "".join(f" --method {each.KIND}" for each in methods)
    specimens = len(np.unique(unseen.specimen))
    return Report(
        results=measured(
            "methods",
            shown.figures(),
            began=began,
            seed=seed,
            quick=quick,
            options=f"--seed {seed}{options}",
        ),
        tables=[shown],
        sentences=[
            f"{len(data) - len(unseen)} frames to learn from, {len(unseen)} of {specimens} other "
            "specimens to be judged by"
        ],
    )


def small_recipe(frames: int, specimens: int) -> Recipe:
    """Recipe `training` with fewer frames and specimens, on a coarse mesh."""
    recipe = Recipe.shipped("training")
    share = frames / sum(group.count for group in recipe.scenes)
    return replace(
        recipe,
        name="methods",
        seed=recipe.seed + 90,
        resolution="coarse",
        specimens=replace(recipe.specimens, count=specimens),
        scenes=tuple(
            replace(group, count=max(specimens, round(share * group.count)))
            for group in recipe.scenes
        ),
    )


def _row(name: str, pipeline: Pipeline, unseen: Dataset, seconds: str) -> tuple[str, ...]:
    """Cells of a pipeline on unseen frames."""
    found = Trial(name, 0.0, "", Evaluation.of(pipeline, unseen), {}).figures
    cells = [
        "" if (value := found[key]) is None else f"{factor * value:.{digits}f}"
        for key, (_, factor, digits) in _COLUMNS.items()
    ]
    touched = np.flatnonzero(unseen.touch_count > 0)[:TIMED].tolist()
    frame_ms = 1e3 * np.median(frame_times(pipeline, unseen, touched, time.process_time))
    return (name, *cells, seconds, f"{frame_ms:.2f}")
