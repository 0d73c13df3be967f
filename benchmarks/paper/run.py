"""Run of the paper's experiments with its own pipeline and with another: `eitskin bench paper`."""

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from eitskin.benchmarks.paper import scores as paper_scores
from eitskin.benchmarks.paper.scores import Figures, SignalToNoise
from eitskin.benchmarks.paper.sets import Sets, make
from eitskin.benchmarks.results import Progress
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.store.dataset import Dataset
from eitskin.errors import ConfigurationError, DataError
from eitskin.training.method.interface import Method
from eitskin.training.method.observations import fingerprint
from eitskin.training.method.settings import TrainingSettings
from eitskin.training.pipeline.pipeline import Pipeline

REFERENCE = Path(__file__).parents[2] / "training" / "reference.eitmodel"
"""The pipeline that comes with the package."""
BOUNDED, BOUNDED_QUICK = 12, 4  # frames of each kind whose bound is computed

PAPER = "paper's"
OWN, UNSEEN, OURS = f"{PAPER}, own sensor", f"{PAPER}, unseen", "ours, unseen"
"""Columns; each further method has two like the paper's, after ours."""


@dataclass(frozen=True, slots=True, eq=False)
class Contender:
    """Further method of the table, trained on the frames of the paper's pipeline.

    Attributes:
        preset: of its settings; empty for a method of the user's own.
        method: of the user's own; None for a preset.
    """

    preset: str = ""
    method: type[Method] | None = None

    def settings(self, seed: int) -> TrainingSettings:
        """Settings of its training."""
        if self.method is None:
            return TrainingSettings.preset(self.preset, seed)
        return TrainingSettings(method=self.method.KIND, seed=seed)

    @property
    def option(self) -> str:
        """Option of the command."""
        if self.method is None:
            return f"--preset {self.preset}"
        module, _, name = self.name.rpartition(":")
        return f"--method {module}.py:{name}"

    @property
    def name(self) -> str:
        """Name in the table."""
        return self.preset if self.method is None else self.method.KIND


@dataclass(frozen=True, slots=True, eq=False)
class PaperComparison:
    """Everything that was measured; every tuple has one entry per seed.

    Attributes:
        began: `time.perf_counter()` at its start [s].
        seeds: of the frames and of the training of the paper's pipeline.
        quick: whether a tenth of the frames had to do.
        pipeline: what "ours" is.
        recipe: of the last seed's frames on unseen sensors: instrument, sensors.
        figures: by column, in the order of the table; of the paper's pipeline of as many seeds as
            it was trained for, perhaps none.
        bounds: of figures, by their names.
        signal_to_noise: of the touches on unseen sensors.
        contenders: further methods.
    """

    began: float
    seeds: tuple[int, ...]
    quick: bool
    pipeline: str
    recipe: Recipe
    figures: dict[str, tuple[Figures, ...]]
    bounds: tuple[Figures, ...]
    signal_to_noise: tuple[SignalToNoise, ...]
    contenders: tuple[Contender, ...] = ()


def run(
    pipeline: Path,
    folder: Path,
    seeds: int = 3,
    quick: bool = False,
    workers: int = 2,
    progress: Progress = lambda *_: None,
    paper_seeds: int | None = None,
    contenders: Sequence[Contender] = (),
) -> PaperComparison:
    """Measure the paper's pipeline, trained here for each seed, and the one at `pipeline`.

    Args:
        pipeline: NAME.eitmodel.
        folder: where frames and the paper's pipelines are kept, and looked for.
        seeds: how many; the first is 0.
        quick: a tenth of the frames.
        workers: processes that generate frames.
        progress: told of every part.
        paper_seeds: of how many seeds the paper's pipeline is trained, which takes ten minutes or
            more each; of all when omitted.
        contenders: further methods, trained like the paper's pipeline for each seed.

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
    figures, bounds, ratios = [], [], []
    for seed in range(seeds):
        place = folder / f"{'quick-' if quick else ''}seed-{seed}"
        sets = make(place, seed, quick, workers, progress)
        trained = {}
        if paper_seeds is None or seed < paper_seeds:
            settings = TrainingSettings.preset("paper", seed)
            trained[PAPER] = _pipeline(sets.training, place / "paper.eitmodel", settings, progress)
        for each in contenders:
            kept = place / f"{each.name.replace(':', '-')}.eitmodel"
            trained[each.name] = _pipeline(
                sets.training, kept, each.settings(seed), progress, each.method
            )
        measured = _measured(sets, trained, ours, seed, quick, progress)
        figures.append(measured[0])
        bounds.append(measured[1])
        ratios.append(SignalToNoise.of(sets.unseen))
    columns = [OWN, UNSEEN, OURS]
    columns += [column for each in contenders for column in columns_of(each.name)]
    return PaperComparison(
        began=began,
        seeds=tuple(range(seeds)),
        quick=quick,
        pipeline=f"{pipeline.name}, {_description(ours)}",
        recipe=sets.recipe,
        figures={
            column: tuple(each[column] for each in figures if column in each) for column in columns
        },
        bounds=tuple(bounds),
        signal_to_noise=tuple(ratios),
        contenders=tuple(contenders),
    )


def _measured(
    sets: Sets,
    trained: Mapping[str, Pipeline],
    ours: Pipeline,
    seed: int,
    quick: bool,
    progress: Progress,
) -> tuple[dict[str, Figures], Figures]:
    def said(what: str, done: int) -> None:
        progress(f"measuring, seed {seed}: {what}", done, len(trained) + 2)

    figures, unseen = {}, {OURS: ours}
    for number, (name, pipeline) in enumerate(trained.items()):
        own_sensor, others_sensors = columns_of(name)
        said(own_sensor, number)
        figures[own_sensor] = paper_scores.scores(pipeline, sets.own)
        unseen[others_sensors] = pipeline
    for column, pipeline in unseen.items():
        said(column, len(trained))
        calibrated = paper_scores.calibrated_scores(pipeline, sets.unseen, sets.calibration)
        figures[column] = paper_scores.scores(pipeline, sets.unseen) | calibrated
    said("bounds", len(trained) + 1)
    count = BOUNDED_QUICK if quick else BOUNDED
    bounds = paper_scores.bounds(sets.unseen, sets.recipe, count, seed)
    said("done", len(trained) + 2)
    return figures, bounds


def columns_of(name: str) -> tuple[str, str]:
    """Columns of a method that is trained here: on the sensor of its training, and on others."""
    return f"{name}, own sensor", f"{name}, unseen"


def _pipeline(
    data: Dataset,
    place: Path,
    settings: TrainingSettings,
    progress: Progress,
    method: type[Method] | None = None,
) -> Pipeline:
    """Pipeline trained on `data`, or loaded from `place` if it is there, valid and the same."""
    with suppress(DataError, ConfigurationError):
        kept = Pipeline.load(place, method)
        if kept.trained_on["sha256"] == fingerprint(data) and kept.settings == settings:
            return kept
    pipeline = Pipeline.fit(data, settings, progress, method)
    pipeline.save(place)
    return pipeline


def _description(pipeline: Pipeline) -> str:
    trained: dict[str, Any] = dict(pipeline.trained_on)
    return (
        f"method {pipeline.method.KIND}, trained on {trained['frames']} {trained['source']} "
        f"frames, seed {pipeline.settings.seed}"
    )
