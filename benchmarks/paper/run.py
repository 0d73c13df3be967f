"""Run of the paper's experiments, their table and picture: `eitskin bench paper`.

Next to the published figures stand those of the paper's pipeline, ours and further methods.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from eitskin.benchmarks.paper import scores as paper_scores
from eitskin.benchmarks.paper.scores import Figures, Sets, make
from eitskin.benchmarks.results import Progress, Report, ReportTable, make_results, plot_errors
from eitskin.datasets import Dataset
from eitskin.geometry import ConfigurationError, DataError
from eitskin.training import Method, Pipeline, TrainingSettings
from eitskin.training.evaluation.scores import GATE, SSIM_DEFINITION
from eitskin.training.method.observations import fingerprint

BOUNDED, BOUNDED_QUICK = 12, 4  # frames of each kind whose bound is computed

PAPER = "paper's"
OWN, UNSEEN, OURS = f"{PAPER}, own sensor", f"{PAPER}, unseen", "ours, unseen"
"""Columns; each further method has two like the paper's, after ours."""
BOUND = "Cramer-Rao bound"
_DIGITS = {"mm": 2, "deg": 2, "%": 2, "ms": 2, "": 3}
_TOUCHES = {
    "indentation.error_mm": ("one, flat\n27 places", 4.8),
    "touch.1.error_mm": ("one,\n-10 to 50 deg", None),
    "touch.2.error_mm": ("two,\n0 to 30 deg", 5.5),
    "touch.3.error_mm": ("three,\n0 to 30 deg", 4.3),
    "touch.4.error_mm": ("four,\n0 to 30 deg", 5.0),
}
"""Name and published error [mm] of the touches in the picture."""


@dataclass(frozen=True, slots=True)
class TableLine:
    """Line of the table.

    Attributes:
        figure: its name in `paper_scores`.
        text: meaning of the figure.
        unit: "mm", "deg", "ms", "%" of a share, or none.
        paper: published value; empty where the paper gives none.
        target: target to be reached; empty where there is none.
    """

    figure: str
    text: str
    unit: str = ""
    paper: str = ""
    target: str = ""


def _touches(name: str, text: str, paper: tuple[str, str], target: str) -> tuple[TableLine, ...]:
    several = target if target.endswith("2.5") else ""
    return (
        TableLine(f"{name}.error_mm", text, "mm", paper[0], target),
        TableLine(f"{name}.deviation_mm", "  standard deviation", "mm", paper[1]),
        TableLine(f"{name}.found", "  found", "%", "", ">= 98" if several else ""),
        TableLine(f"{name}.false", "  false, per touch", "%", "", "<= 2" if several else ""),
    )


def _pictures(
    group: str, text: str, paper: tuple[str, str, str], target: str
) -> tuple[TableLine, ...]:
    return (
        TableLine(f"{group}.ssim.static", f"{text}: SSIM, static reference", "", paper[0]),
        TableLine(f"{group}.ssim.dynamic", "  dynamic reference", "", paper[1]),
        TableLine(f"{group}.ssim.touch_map", "  touch map", "", paper[2], target),
        TableLine(f"{group}.ssim.empty", "  empty picture", ""),
    )


LINES: tuple[TableLine, ...] = (
    *_touches("indentation", "one touch at 27 places, flat: error", ("4.8", "2.8"), "<= 1.5"),
    *_touches("touch.1", "one touch at -10 to 50 deg: error", ("", ""), "<= 1.5"),
    *_touches("touch.2", "two touches at 0 to 30 deg: error", ("5.5", ""), "<= 2.5"),
    *_touches("touch.3", "three touches at 0 to 30 deg: error", ("4.3", ""), "<= 2.5"),
    *_touches("touch.4", "four touches at 0 to 30 deg: error", ("5.0", ""), "<= 2.5"),
    *_pictures("touch.1", "one touch", ("0.29", "0.71", "0.94"), ">= 0.97"),
    *_pictures("touch.several", "several touches", ("0.11", "0.47", "0.80"), ">= 0.90"),
    TableLine("state.idle", "idle recognised", "%", "> 97", ">= 99.5"),
    TableLine("state.touch", "touch recognised", "%", "99", ">= 99.5"),
    TableLine("state.bend", "bend recognised", "%", "", ">= 99.5"),
    TableLine("touch.state", "touch on a bent sensor recognised", "%", "", ">= 99.5"),
    TableLine("bend.r2", "bend angle: R2", "", "0.997"),
    TableLine("bend.angle_deg", "  RMSE", "deg", "0.90"),
    TableLine("touch.angle_deg", "  RMSE while touched", "deg"),
    TableLine("sequence.angle_deg", "  RMSE in a continuous sequence", "deg"),
    TableLine("calibrated.r2", "bend angle, calibrated: R2"),
    TableLine("calibrated.angle_deg", "  RMSE", "deg", "", "<= 0.3"),
    TableLine("calibrated.touched_deg", "  RMSE while touched", "deg", "", "<= 0.6"),
    TableLine("demo.state", "demonstration: state right", "%"),
    TableLine("demo.angle_deg", "  angle, RMSE", "deg"),
    TableLine("time.p50_ms", "processing of a touched frame, median", "ms", "303.6"),
    TableLine("time.p99_ms", "  99th percentile", "ms", "", "<= 5"),
)
"""The paper's time is the mean of 606.6 ms less 303 ms of acquisition; its angle is of the sensor
that was trained with, its sequence has no figure."""


@dataclass(frozen=True, slots=True, eq=False)
class Contender:
    """Further method of the table, trained on the frames of the paper's pipeline.

    Attributes:
        preset: preset of its settings; empty for a method of the user's own.
        method: method of the user's own; None for a preset.
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


def run(
    pipeline: Path,
    folder: Path,
    seeds: int = 3,
    quick: bool = False,
    workers: int = 2,
    progress: Progress = lambda *_: None,
    paper_seeds: int | None = None,
    contenders: Sequence[Contender] = (),
) -> Report:
    """Measure the paper's pipeline, trained here for each seed, and the one at `pipeline`.

    Frames and the paper's pipelines are kept in `folder`, and looked for there. The paper's
    pipeline is trained for `paper_seeds` of the seeds, which takes ten minutes or more each; for
    all when omitted. Contenders are trained like it. A quick run has a tenth of the frames.

    Raises ConfigurationError for no seeds, no pipeline, or a folder with frames of other recipes.
    """
    if seeds < 1:
        raise ConfigurationError(f"a benchmark needs at least one seed, got {seeds}")
    if not pipeline.is_dir():
        raise ConfigurationError(
            f"there is no pipeline at {pipeline}; name one that eitskin train has made, with "
            "--pipeline NAME.eitmodel"
        )
    began, ours = time.perf_counter(), Pipeline.load(pipeline)
    columns = [
        OWN,
        UNSEEN,
        OURS,
        *(name for each in contenders for name in method_columns(each.name)),
    ]
    figures: dict[str, list[Figures]] = {name: [] for name in columns}
    bounds: list[Figures] = []
    for seed in range(seeds):
        place = folder / f"{'quick-' if quick else ''}seed-{seed}"
        sets = make(place, seed, quick, workers, progress)
        trained = {}
        if paper_seeds is None or seed < paper_seeds:
            settings = TrainingSettings.preset("paper", seed)
            trained[PAPER] = _pipeline(sets.training, place / "paper.eitmodel", settings, progress)
        for contender in contenders:
            pipeline_path = place / f"{contender.name.replace(':', '-')}.eitmodel"
            trained[contender.name] = _pipeline(
                sets.training, pipeline_path, contender.settings(seed), progress, contender.method
            )

        def note(part: str, done: int, text: str = f"measuring, seed {seed}") -> None:
            progress(f"{text}: {part}", done, len(trained) + 2)  # noqa: B023 - called at once

        for column, values in _measure_figures(sets, trained, ours, note):
            figures[column].append(values)
        note("bounds", len(trained) + 1)
        count = BOUNDED_QUICK if quick else BOUNDED
        bounds.append(paper_scores.bounds(sets.unseen, sets.recipe, count, seed))
        note("done", len(trained) + 2)
    options = f"--seeds {seeds} --paper-seeds {len(figures[OWN])}"
    options += "".join(f" {contender.option}" for contender in contenders)
    measured_columns = {name: values for name, values in figures.items() if values}
    with_bounds = measured_columns | {BOUND: bounds}
    shown = ReportTable(
        ("experiment", "paper", *measured_columns, "to reach", "bound", "ours / bound"),
        list(_table(measured_columns, bounds)),
    )
    return Report(
        results=make_results(
            "paper", _figures(with_bounds), began=began, quick=quick, options=options
        ),
        rows=[
            {"column": column, "seed": seed, "figure": figure, "value": value}
            for column, some in with_bounds.items()
            for seed, values in enumerate(some)
            for figure, value in values.items()
        ],
        tables=[shown],
        sentences=[
            f"seeds {', '.join(map(str, range(seeds)))}; +- standard deviation over them",
            f"ours: {pipeline.name}, {_description(ours)}, on unseen sensors; the paper's is "
            "trained on one sensor",
            SSIM_DEFINITION,
            f"touches are matched by the Hungarian method within {1e3 * GATE:g} mm",
            "bounds: white noise alone, of the nominal sensor, some of the frames, one at a time",
            f"instrument: {_terms(sets.recipe.instrument)}",
            f"specimens: {_terms(sets.recipe.specimens)}",
        ],
        plots={"paper-touches.png": partial(_plot_touches, with_bounds)},
    )


def _measure_figures(
    sets: Sets,
    trained: Mapping[str, Pipeline],
    ours: Pipeline,
    note: Callable[[str, int], None],
) -> Iterator[tuple[str, Figures]]:
    unseen = {OURS: ours}
    for number, (name, pipeline) in enumerate(trained.items()):
        own_sensor, others_sensors = method_columns(name)
        note(own_sensor, number)
        yield own_sensor, paper_scores.scores(pipeline, sets.own)
        unseen[others_sensors] = pipeline
    for column, pipeline in unseen.items():
        note(column, len(trained))
        calibrated = paper_scores.calibrated_scores(pipeline, sets.unseen, sets.calibration)
        yield column, paper_scores.scores(pipeline, sets.unseen) | calibrated


def method_columns(name: str) -> tuple[str, str]:
    """Columns of a method that is trained here: on the sensor of its training, and on others."""
    return f"{name}, own sensor", f"{name}, unseen"


def _pipeline(
    data: Dataset,
    path: Path,
    settings: TrainingSettings,
    progress: Progress,
    method: type[Method] | None = None,
) -> Pipeline:
    """Pipeline trained on `data`, or loaded from `path` if it is there, valid and the same."""
    with suppress(DataError, ConfigurationError):
        kept = Pipeline.load(path, method)
        if kept.trained_on["sha256"] == fingerprint(data) and kept.settings == settings:
            return kept
    pipeline = Pipeline.fit(data, settings, progress, method)
    pipeline.save(path)
    return pipeline


def _description(pipeline: Pipeline) -> str:
    trained: dict[str, Any] = dict(pipeline.trained_on)
    return (
        f"method {pipeline.method.KIND}, trained on {trained['frames']} {trained['source']} "
        f"frames, seed {pipeline.settings.seed}"
    )


def _table(
    columns: Mapping[str, Sequence[Figures]], bounds: Sequence[Figures]
) -> Iterator[tuple[str, ...]]:
    """Rows of the table: mean and standard deviation over the seeds.

    Indented lines that no column has a figure for are left out; others head what follows them.
    """
    for line in LINES:
        cells_of = {name: _values(figures, line) for name, figures in columns.items()}
        if line.text.startswith(" ") and not any(cells_of.values()):
            continue
        ours, bound = cells_of[OURS], _values(bounds, line)
        multiple = f"{np.mean(ours) / np.mean(bound):.1f}" if ours and bound else ""
        cells = (_cell(values, line.unit) for values in cells_of.values())
        text = f"{line.text} [{line.unit}]" if line.unit else line.text
        yield text, line.paper, *cells, line.target, _cell(bound, line.unit), multiple


def _values(figures: Sequence[Figures], line: TableLine) -> list[float]:
    """Values of the seeds that have one."""
    factor = 100.0 if line.unit == "%" else 1.0
    return [factor * figure[line.figure] for figure in figures if line.figure in figure]


def _cell(values: Sequence[float], unit: str) -> str:
    if not values:
        return ""
    digits = _DIGITS[unit]
    mean = f"{np.mean(values):.{digits}f}"
    return mean if len(values) == 1 else f"{mean} +- {np.std(values, ddof=1):.{digits}f}"


def _terms(terms: Any) -> str:
    return ", ".join(f"{name} {value}" for name, value in asdict(terms).items() if value)


def _figures(columns: Mapping[str, Sequence[Figures]]) -> Iterator[tuple[str, float]]:
    """Means over the seeds as `COLUMN: FIGURE`, deviations with ` +-`, shares in percent."""
    for column, seeds in columns.items():
        for line in LINES:
            values = _values(seeds, line)
            if values:
                yield f"{column}: {line.figure}", float(np.mean(values))
            if len(values) > 1:
                yield f"{column}: {line.figure} +-", float(np.std(values, ddof=1))


def _plot_touches(columns: Mapping[str, Sequence[Figures]], path: Path) -> None:
    """Plot localisation errors by experiment, next to the paper's and the bounds."""
    ticks = [text for text, _ in _TOUCHES.values()]
    points = {
        column: [
            (float(place), float(np.mean(values)))
            for place, name in enumerate(_TOUCHES)
            if (values := [seed[name] for seed in seeds if name in seed])
        ]
        for column, seeds in columns.items()
    }
    points["published"] = [(float(k), e) for k, (_, e) in enumerate(_TOUCHES.values()) if e]
    plot_errors(path, {"": points}, "", "mean error of a found touch [mm]", ticks=ticks)
