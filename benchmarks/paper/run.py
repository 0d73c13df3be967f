"""Run of the paper's experiments with its own pipeline and with another: `eitskin bench paper`."""

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from eitskin.benchmarks.paper import limits as paper_limits
from eitskin.benchmarks.paper import scores as paper_scores
from eitskin.benchmarks.paper.limits import SignalToNoise
from eitskin.benchmarks.paper.scores import Figures
from eitskin.benchmarks.paper.sets import Progress, Sets, make
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.store.dataset import Dataset
from eitskin.errors import ConfigurationError, DataError
from eitskin.provenance import Provenance
from eitskin.training.method.observations import fingerprint
from eitskin.training.method.settings import TrainingSettings
from eitskin.training.pipeline.pipeline import Pipeline

REFERENCE = Path(__file__).parents[2] / "training" / "reference.eitmodel"
"""The pipeline that comes with the package."""
BOUNDED, BOUNDED_QUICK = 12, 4  # frames of each kind whose bound is computed

OWN, UNSEEN, OURS = "paper's, own sensor", "paper's, unseen", "ours, unseen"
COLUMNS = (OWN, UNSEEN, OURS)

Variants = Callable[[Pipeline], Sequence[tuple[str, Pipeline]]]


@dataclass(frozen=True, slots=True, eq=False)
class Variant:
    """Pipeline variant, measured on all touches of the unseen sensors.

    Attributes:
        name: in words.
        figures: of `paper_scores.touch_scores`, one of each seed.
    """

    name: str
    figures: tuple[Figures, ...]


@dataclass(frozen=True, slots=True, eq=False)
class PaperComparison:
    """Everything that was measured; every tuple has one entry per seed.

    Attributes:
        provenance: of the measurement; its seed is the last.
        seconds: that the run took [s], less where frames were kept from an earlier one.
        seeds: of the frames and of the training of the paper's pipeline.
        quick: whether a tenth of the frames had to do.
        pipeline: what "ours" is.
        recipe: of the last seed's frames on unseen sensors: instrument, sensors.
        figures: by column; of the paper's pipeline of as many seeds as it was trained for.
        bounds: of figures, by their names.
        signal_to_noise: of the touches on unseen sensors.
        variants: for the plot of error against time.
    """

    provenance: Provenance
    seconds: float
    seeds: tuple[int, ...]
    quick: bool
    pipeline: str
    recipe: Recipe
    figures: dict[str, tuple[Figures, ...]]
    bounds: tuple[Figures, ...]
    signal_to_noise: tuple[SignalToNoise, ...]
    variants: tuple[Variant, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Measured:
    """Measurements of one seed."""

    recipe: Recipe
    figures: dict[str, Figures]
    bounds: Figures
    signal_to_noise: SignalToNoise
    variants: dict[str, Figures]


def no_variants(ours: Pipeline) -> Sequence[tuple[str, Pipeline]]:  # noqa: ARG001
    """Empty choice of variants: only the two pipelines of the table."""
    return ()


def run(
    pipeline: Path,
    folder: Path,
    seeds: int = 3,
    quick: bool = False,
    workers: int = 2,
    progress: Progress = lambda *_: None,
    variants: Variants = no_variants,
    paper_seeds: int | None = None,
) -> PaperComparison:
    """Measure the paper's pipeline, trained here for each seed, and the one at `pipeline`.

    Args:
        pipeline: NAME.eitmodel.
        folder: where frames and the paper's pipelines are kept, and looked for.
        seeds: how many; the first is 0.
        quick: a tenth of the frames.
        workers: processes that generate frames.
        progress: told of every part.
        variants: of the pipeline, by name, for the plot of error against time.
        paper_seeds: of how many seeds the paper's pipeline is trained, which takes ten minutes or
            more each; of all when omitted.

    Raises ConfigurationError for no seeds, no pipeline, or a folder with frames of other recipes.
    """
    if seeds < 1:
        raise ConfigurationError(f"a benchmark needs at least one seed, got {seeds}")
    if not pipeline.is_dir():
        raise ConfigurationError(
            f"there is no pipeline at {pipeline}; name one that eitskin train has made, with "
            "--pipeline NAME.eitmodel"
        )
    began = time.perf_counter()
    ours = Pipeline.load(pipeline)
    parts = []
    for seed in range(seeds):
        place = folder / f"{'quick-' if quick else ''}seed-{seed}"
        sets = make(place, seed, quick, workers, progress)
        paper = None
        if paper_seeds is None or seed < paper_seeds:
            paper = _paper_pipeline(sets.training, place / "paper.eitmodel", seed, progress)
        parts.append(_measured(sets, paper, ours, variants(ours), seed, quick, progress))
    names = list(parts[0].variants)
    return PaperComparison(
        provenance=Provenance.now(seeds - 1),
        seconds=time.perf_counter() - began,
        seeds=tuple(range(seeds)),
        quick=quick,
        pipeline=f"{pipeline.name}, {_description(ours)}",
        recipe=parts[-1].recipe,
        figures={
            column: tuple(part.figures[column] for part in parts if column in part.figures)
            for column in COLUMNS
        },
        bounds=tuple(part.bounds for part in parts),
        signal_to_noise=tuple(part.signal_to_noise for part in parts),
        variants=tuple(
            Variant(n, tuple(part.variants[n] for part in parts if n in part.variants))
            for n in names
        ),
    )


def _measured(
    sets: Sets,
    paper: Pipeline | None,
    ours: Pipeline,
    variants: Iterable[tuple[str, Pipeline]],
    seed: int,
    quick: bool,
    progress: Progress,
) -> _Measured:
    def said(what: str, done: int) -> None:
        progress(f"measuring, seed {seed}: {what}", done, 5)

    said(OWN, 0)
    figures = {}
    measured = [(OURS, ours)]
    if paper is not None:
        figures[OWN] = paper_scores.scores(paper, sets.own)
        measured.insert(0, (UNSEEN, paper))
    for number, (column, pipeline) in enumerate(measured, 1):
        said(column, number)
        calibrated = paper_scores.calibrated_scores(pipeline, sets.unseen, sets.calibration)
        figures[column] = paper_scores.scores(pipeline, sets.unseen) | calibrated
    said("variants", 3)
    others = {
        name: paper_scores.touch_scores(pipeline, sets.unseen["touch"])
        for name, pipeline in variants
    }
    said("bounds", 4)
    count = BOUNDED_QUICK if quick else BOUNDED
    bounds = paper_limits.bounds(sets.unseen, sets.recipe, count, seed)
    said("done", 5)
    stages = {"paper's stages": figures[UNSEEN]} if paper is not None else {}
    return _Measured(
        sets.recipe,
        figures,
        bounds,
        SignalToNoise.of(sets.unseen),
        {**stages, "ours": figures[OURS], **others},
    )


def _paper_pipeline(data: Dataset, place: Path, seed: int, progress: Progress) -> Pipeline:
    """Pipeline trained as published on `data`, or loaded from `place` if it is there and valid."""
    settings = TrainingSettings.preset("paper", seed)
    with suppress(DataError):
        kept = Pipeline.load(place)
        if kept.trained_on["sha256"] == fingerprint(data) and kept.settings == settings:
            return kept
    pipeline = Pipeline.fit(data, settings, progress)
    pipeline.save(place)
    return pipeline


def _description(pipeline: Pipeline) -> str:
    trained: dict[str, Any] = dict(pipeline.trained_on)
    return (
        f"method {pipeline.method.KIND}, trained on {trained['frames']} {trained['source']} "
        f"frames, seed {pipeline.settings.seed}"
    )
