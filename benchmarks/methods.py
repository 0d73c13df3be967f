"""Methods side by side, on the same frames and the same unseen specimens: `eitskin bench methods`.

The frames are a small part of the recipe `training`, on a coarse mesh. The last row is the pipeline
that ships with eitskin, which has learned from other frames, of 500 other specimens. Times are of
the processor, which other programs do not lengthen.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from eitskin.benchmarks.paper.run import Contender
from eitskin.benchmarks.paper.scores import frame_times, generate_missing
from eitskin.benchmarks.results import Columns, Progress, Report, ReportTable, make_results
from eitskin.datasets import Dataset, Recipe
from eitskin.training import Method, Pipeline
from eitskin.training.evaluation.evaluate import Evaluation
from eitskin.training.evaluation.selection import Trial
from eitskin.training.method.settings import BASELINES
from eitskin.training.pipeline.saved_form import SHIPPED_PATH

FRAMES, SPECIMENS = 2000, 40
QUICK_FRAMES, QUICK_SPECIMENS = 300, 6
TIMED_FRAMES = 100  # frames
_COLUMNS: Columns = {
    "": ("method", "", 1),
    "states right, %": ("states", ".1f", 100.0),
    "touches: error, mm": ("error_mm", ".2f", 1.0),
    "found, %": ("found", ".1f", 100.0),
    "false, %": ("false_per_touch", ".1f", 100.0),
    "angle: RMSE, deg": ("angle_rmse_deg", ".2f", 1.0),
    "training, s": ("training_s", ".1f", 1.0),
    "frame, ms": ("frame_ms", ".2f", 1.0),
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
    """Train and test methods of presets and one's own; the baselines where none is named.

    Frames are kept in `folder`; a quick run has fewer frames and specimens.
    """
    began, place = time.perf_counter(), folder / ("quick-frames" if quick else "frames")
    recipe = small_recipe(*((QUICK_FRAMES, QUICK_SPECIMENS) if quick else (FRAMES, SPECIMENS)))

    data = generate_missing(recipe, place, workers, progress, "frames")
    named = [*map(Contender, presets), *(Contender(method=method) for method in methods)]
    contenders = named or [*map(Contender, BASELINES)]
    rows = []
    for number, contender in enumerate(contenders):
        progress(contender.name, number, len(contenders))
        start = time.process_time()
        settings = replace(contender.settings(seed), whole_specimens=True)
        pipeline = Pipeline.fit(data, settings, method=contender.method)
        seconds = time.process_time() - start
        unseen = data.select(pipeline.held_out(data))
        rows.append(_row(contender.name, pipeline, unseen) | {"training_s": seconds})
    rows.append(_row("shipped", Pipeline.load(SHIPPED_PATH), unseen))
    shown = ReportTable.from_rows(rows, _COLUMNS)
    options = "".join(f" {each.option}" for each in named)
    specimens = len(np.unique(unseen.specimen))
    return Report(
        results=make_results(
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
            "specimens to test on"
        ],
    )


def small_recipe(frames: int, specimens: int) -> Recipe:
    """Recipe `training` with fewer frames and specimens, on a coarse mesh."""
    recipe = Recipe.from_shipped("training")
    share = frames / sum(group.count for group in recipe.scenes)
    return replace(
        recipe,
        name="methods",
        seed=recipe.seed + 90,
        resolution="coarse",
        reference_frames=1,
        touch_frames=1,
        specimens=replace(recipe.specimens, count=specimens),
        scenes=tuple(
            replace(group, count=max(specimens, round(share * group.count)))
            for group in recipe.scenes
        ),
    )


def _row(name: str, pipeline: Pipeline, unseen: Dataset) -> dict[str, Any]:
    """Figures of a pipeline on unseen frames."""
    touched = np.flatnonzero(unseen.touch_count > 0)[:TIMED_FRAMES].tolist()
    seconds = frame_times(pipeline, unseen, touched, time.process_time)
    figures = Trial(name, 0.0, "", Evaluation.from_dataset(pipeline, unseen), {}).figures
    return {"method": name, "frame_ms": 1e3 * float(np.median(seconds)), **figures}
