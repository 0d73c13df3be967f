"""Methods side by side: the same frames to learn from, the same unseen specimens to be judged by.

    python -m eitskin.benchmarks.skinbench.methods --out FOLDER [--frames 2000] [--specimens 40]
        [--presets ridge ... quick joint] [--methods FILE.py:CLASS ...] [--leaderboard FILE]

The baselines are trained where no presets are named. FOLDER keeps the frames: a small part of the
recipe `training`, on a coarse mesh. Prints a table in Markdown; its last row is the pipeline that
comes with eitskin, which has learned from other frames, of 500 other specimens. Times are of the
processor, which other programs do not lengthen. With a leaderboard of skinbench the rows are
entered there, too, where all frames are asked for.
"""

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from eitskin.benchmarks.markdown_tables import figures
from eitskin.benchmarks.results import Results
from eitskin.benchmarks.skinbench.leaderboard import (
    code_digest,
    frames_digest,
    read_leaderboard,
    write_leaderboard,
)
from eitskin.benchmarks.skinbench.tracks import SEED
from eitskin.datasets.generation.generate import generate
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.folder import open_dataset
from eitskin.provenance import Provenance
from eitskin.training.evaluation.evaluate import Evaluation
from eitskin.training.evaluation.selection import Trial
from eitskin.training.method.interface import Method
from eitskin.training.method.settings import BASELINES, TrainingSettings
from eitskin.training.pipeline.methods import named_method
from eitskin.training.pipeline.pipeline import Pipeline

MODULE = "eitskin.benchmarks.skinbench.methods"
FRAMES, SPECIMENS = 2000, 40
PRESETS = (*BASELINES, "paper", "quick", "joint")
SHIPPED = "reference.eitmodel"
TIMED = 100  # frames
HEADINGS = {
    "states": "states right, %",
    "error_mm": "touches: error, mm",
    "found": "found, %",
    "false_per_touch": "false, %",
    "angle_rmse_deg": "angle: RMSE, deg",
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of the frames")
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--specimens", type=int, default=SPECIMENS)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--presets", nargs="*", default=BASELINES, choices=PRESETS)
    parser.add_argument("--methods", nargs="*", default=(), help="FILE.py:CLASS")
    parser.add_argument("--leaderboard", type=Path, help="of skinbench, a JSON file")
    options = parser.parse_args()
    quick = (options.frames, options.specimens) != (FRAMES, SPECIMENS)
    if options.leaderboard is not None and (quick or options.seed):
        parser.error("a leaderboard takes all frames, with seed 0")
    place = options.out / "frames"
    recipe = small_recipe(options.frames, options.specimens)
    generate(recipe, place, options.workers, resume=(place / "recipe.toml").is_file())
    data = open_dataset(place)
    own: list[type[Method]] = [named_method(name) for name in options.methods]
    asked = [
        *((name, TrainingSettings.preset(name, options.seed), None) for name in options.presets),
        *((each.KIND, TrainingSettings(seed=options.seed), each) for each in own),
    ]
    lines = [f"| | {' | '.join(HEADINGS.values())} | training, s | frame, ms |"]
    lines.append("| --- " * (len(HEADINGS) + 3) + "|")
    print("\n".join(lines))
    for name, settings, method in asked:
        start = time.process_time()
        pipeline = Pipeline.fit(data, replace(settings, whole_specimens=True), method=method)
        seconds = time.process_time() - start
        unseen = data.select(pipeline.held_out(data))
        lines.append(row(name, pipeline, unseen, f"{seconds:.1f}"))
        print(lines[-1], flush=True)
    lines.append(row("shipped", Pipeline.load(SHIPPED), unseen, ""))
    print(lines[-1])
    specimens = len(np.unique(unseen.specimen))
    print(
        f"\n{len(data) - len(unseen)} frames to learn from, {len(unseen)} of {specimens} other "
        f"specimens to be judged by; {Provenance.now(options.seed)}"
    )
    if options.leaderboard is not None:
        words = ["--presets", *options.presets]
        words += ["--methods", *options.methods] if own else []
        codes = {method.KIND: code for method, code in zip(own, options.methods, strict=True)}
        enter(options.leaderboard, "\n".join(lines), " ".join(words), codes, place)


def enter(
    leaderboard: Path, table: str, words: str, codes: Mapping[str, str], frames: Path
) -> None:
    """Enter the rows of a table into a leaderboard of skinbench.

    Args:
        leaderboard: its file.
        table: Markdown.
        words: options that it was measured with.
        codes: FILE.py:CLASS of own methods, by their names.
        frames: folder of the dataset.
    """
    results = Results(
        name="methods",
        command=f"python -m {MODULE} {words}",
        provenance=Provenance.now(SEED),
        figures=figures(table),
    )
    digests = {name: code_digest(code) for name, code in codes.items()}
    board = read_leaderboard(leaderboard)
    write_leaderboard(leaderboard, board.with_results(results, frames_digest(frames), digests))


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


def row(name: str, pipeline: Pipeline, unseen: Dataset, seconds: str) -> str:
    """Row of the table: figures of a pipeline on unseen frames."""
    found = Trial(name, 0.0, "", Evaluation.of(pipeline, unseen), {}).figures
    cells: Sequence[str] = [
        "" if (value := found[key]) is None else f"{factor * value:.{digits}f}"
        for key, factor, digits in (
            ("states", 100.0, 1),
            ("error_mm", 1.0, 2),
            ("found", 100.0, 1),
            ("false_per_touch", 100.0, 1),
            ("angle_rmse_deg", 1.0, 2),
        )
    ]
    return f"| {name} | {' | '.join(cells)} | {seconds} | {frame_ms(pipeline, unseen):.2f} |"


def frame_ms(pipeline: Pipeline, data: Dataset) -> float:
    """Median processor time of `process` for a touched frame [ms], after its two references."""
    times = []
    for number in np.flatnonzero(data.touch_count > 0)[:TIMED].tolist():
        pipeline.reset()
        flat, free = data.reference[data.specimen[number]], data.touch_reference[number]
        for n, values in enumerate((flat, free, data.impedance[number])):
            impedance = values.astype(np.complex128)
            frame = replace(data.frame(0), impedance=impedance, number=n, time=0.3 * n)
            start = time.process_time()
            pipeline.process(frame)
        times.append(time.process_time() - start)
    pipeline.reset()
    return 1e3 * float(np.median(times))


if __name__ == "__main__":
    main()
