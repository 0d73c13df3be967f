"""Real recordings through the same code as simulated frames: `eitskin bench recordings`.

The folder of the data holds `ohmc8.mat` (DSHardman/HydrogelEIT), 500 presses of a robot on a round
hydrogel skin in the order of time; `openeit_background_8.txt`, a frame of all 28 pairs of another
board; and `ktc2023_ref.mat`, a round tank of plain water with 32 electrodes (Kuopio Tomography
Challenge 2023, Zenodo 8252370).

Measured are the places of the last 100 presses, learned from k random presses of the first 400
(means over seven draws), by maps of the channels with and without the sensor's design, and by
regression; the same presses with an electrode that fails, next to maps that were never taught it;
the size of the other board's values next to those of the shipped pipeline, and whether
it accepts them; and what a fit of one conductivity leaves of the tank's voltages.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.results import Report, ReportTable, Watch, make_results, plot_errors
from eitskin.benchmarks.tank_targets import TANK, tank_frame
from eitskin.datasets import RecordingForm, RecordingNames, read_recording
from eitskin.extras import require
from eitskin.geometry import DataError, FrameError, SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import ForwardModel, Protocol
from eitskin.simulator.electrical.resolution import Discretisation
from eitskin.training import Pipeline
from eitskin.training.adaptation.press_fit import LabelledPresses, learn_places
from eitskin.training.method.sensor_health import ReadingRange, SensorHealth, electrode_members

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
Method = Callable[[LabelledPresses, Rows, Rows], tuple[Array, Array]]

PRESSES, BOARD_FRAME = "ohmc8.mat", "openeit_background_8.txt"
TANK_FRAME = "ktc2023_ref.mat"
DESCRIPTIONS = Path(__file__).parents[1] / "docs" / "how-to" / "recordings"
COUNTS, QUICK_COUNTS = (5, 20, 50, 200, 400), (5, 50)
DRAWS, TESTED = 7, 100
FAILED, QUICK_FAILED = (0, 3, 5), (3,)  # electrodes
# The first as fine as the mesh that the challenge gives, the second the same with quadratics.
MESHES: dict[str, Discretisation] = {
    "order 1": ((1,), Grading(finest=5.6e-3, coarsest=6e-3, growth=1.0)),
    "order 2": ((2,), Grading(finest=5.6e-3, coarsest=6e-3, growth=1.0)),
    "order 3, graded": ((3,), Grading(finest=1e-3, coarsest=3e-2, growth=1.5)),
    "order 4, graded": ((4,), Grading(finest=2e-4, coarsest=3e-2, growth=1.5)),
}
CONTACT_IMPEDANCE = 1e-7  # of the tank's model [ohm m2]: the fit is best as it vanishes


def run(folder: Path, quick: bool, watch: Watch = lambda _, items: items) -> Report:
    """Measure the recordings in a folder; quickly by few presses, one draw and the first mesh.

    Raises DataError where a file is missing.
    """
    for name in (PRESSES, BOARD_FRAME, TANK_FRAME):
        if not (folder / name).is_file():
            raise DataError(f"{folder / name} is not there; name the folder of the recordings")
    began = time.perf_counter()
    skin, counts = read_skin(folder), QUICK_COUNTS if quick else COUNTS
    errors: list[tuple[str, int, float, float]] = []
    for count in watch("presses", counts):
        errors += place_errors(skin, count, 1 if quick else DRAWS)
    failed = dict(failed_electrode_errors(skin, QUICK_FAILED if quick else FAILED))
    ratio, accepted = judge_board_frame(folder / BOARD_FRAME)
    frame = tank_frame(folder / TANK_FRAME)
    fits = [
        (name, fit_tank(*frame, MESHES[name]))
        for name in watch("tank", list(MESHES)[: 1 if quick else None])
    ]
    places = dict(_mean_errors(errors))
    methods = list(dict.fromkeys(method for method, *_ in errors))
    figures = places | {
        "mean error of a place [mm]": places[f"{counts[-1]} / {methods[0]}"],
        "the same of always saying the middle [mm]": places[f"{counts[-1]} / mean place"],
        "values of another board beside those trained with": ratio,
    }
    figures |= failed
    for name, residuals in fits:
        figures |= {f"tank, {name} / {part}": 100 * value for part, value in residuals.items()}
    rows = [(str(k), *(f"{places[f'{k} / {name}']:.1f}" for name in methods)) for k in counts]
    tank = [(name, *(f"{value:.2%}" for value in errors.values())) for name, errors in fits]
    points = {name: [(k, places[f"{k} / {name}"]) for k in counts] for name in methods}
    return Report(
        results=make_results(
            "recordings", figures.items(), began=began, quick=quick, options="DATA"
        ),
        rows=[
            {"method": method, "presses": count, "error_mm": error, "error_ratio": over}
            for method, count, error, over in errors
        ],
        tables=[
            ReportTable(("presses: mean error [mm]", *methods), rows),
            ReportTable(
                ("an electrode fails", "value"),
                [(name, f"{value:.2f}") for name, value in failed.items()],
            ),
            ReportTable(("tank: residual", *fits[0][1]), tank),
        ],
        sentences=[f"values of another board: {ratio:.1f} times those trained with; {accepted}"],
        plots={
            "adaptation.png": partial(
                plot_errors,
                panels={"": points},
                x="labelled presses",
                y="mean error of a place [mm]",
            )
        },
    )


def read_skin(folder: Path) -> LabelledPresses:
    """Presses of the round skin in a folder."""
    design = SensorDesign.from_toml(DESCRIPTIONS / "round-skin.toml")
    names = RecordingNames(
        "responsedowns", "responseups", "positions", columns={"depth": "positions:2"}
    )
    protocol = Protocol.from_file(DESCRIPTIONS / "round-skin.csv", 8)
    form = RecordingForm(origin="centre")
    recording = read_recording(folder / PRESSES, names, protocol, design=design, form=form)
    return LabelledPresses.from_dataset(recording)


def failed_electrode_errors(
    skin: LabelledPresses, electrodes: Sequence[int]
) -> Iterator[tuple[str, float]]:
    """Figures of the last presses where an electrode fails before them, by name.

    Three quarters of its channels jump by 0.3 to 2.3 in the logarithm, answer a third as much and
    scatter by 3 %. They are compared with what was learned from the other electrodes alone.
    """
    first = len(skin) - TESTED
    learned = learn_places(skin.select(np.arange(first))).locator
    members = electrode_members(skin.protocol, skin.ratios.shape[1])
    steady = np.tile(np.linspace(1.0, 2.0, skin.ratios.shape[1]), (first, 1))
    usual = ReadingRange.fit(steady, skin.ratios[:first])
    for electrode in electrodes:
        rng = np.random.default_rng(electrode)
        mine = rng.permutation(np.flatnonzero(members[electrode]))
        mine = mine[: -(-3 * len(mine) // 4)]
        jump = rng.choice([-1.0, 1.0], len(mine)) * rng.uniform(0.3, 2.3, len(mine))
        ratios, before = skin.ratios[first:].copy(), np.tile(steady[0], (TESTED, 1))
        scatter = np.exp(0.03 * rng.standard_normal((2, TESTED, len(mine))))
        ratios[:, mine] = ratios[:, mine] ** (1 / 3) * scatter[0]
        before[:, mine] *= np.exp(jump) * scatter[1]
        health = SensorHealth(usual, skin.protocol)
        named = TESTED
        for row, reading in enumerate(before):
            ratios[row, health.follow(reading, row, float(row), untouched=True)] = np.nan
            named = min(named, row) if electrode in health.faults else named
        located, _ = learned.locate(ratios)
        other = skin.ratios.copy()
        other[:, members[electrode]] = np.nan
        alone = learn_places(replace(skin, ratios=other).select(np.arange(first))).locator
        true = skin.places[first:]
        error, target = (
            np.linalg.norm(place - true, axis=1)
            for place in (located.place, alone.apply(other[first:]))
        )
        name = f"electrode {electrode} fails"
        yield f"{name} / error [mm]", 1e3 * float(error.mean())
        yield f"{name} / never taught it [mm]", 1e3 * float(target.mean())
        over = float(np.sqrt(np.mean((error / located.deviation) ** 2)))
        yield f"{name} / error over standard error", over
        yield f"{name} / frames until it is named", float(named)


def place_errors(
    skin: LabelledPresses, count: int, draws: int
) -> Iterator[tuple[str, int, float, float]]:
    """Method, number of presses, mean error [mm], and error over standard error, of each draw."""
    first = len(skin) - TESTED
    test = np.arange(first, len(skin))
    for draw in range(draws if count < first else 1):
        train = np.sort(np.random.default_rng(draw).permutation(first)[:count])
        for name, method in _methods().items():
            place, deviation = method(skin, train, test)
            error = np.linalg.norm(place - skin.places[test], axis=1)
            ratio = float(np.sqrt(np.mean((error / deviation) ** 2)))
            yield name, count, 1e3 * float(error.mean()), ratio


def _methods() -> dict[str, Method]:
    """Methods by name: places of tested presses and their standard errors, NaN without any."""
    ensemble, linear = (
        require(f"sklearn.{name}", "training") for name in ("ensemble", "linear_model")
    )

    def maps(design: bool, skin: LabelledPresses, train: Rows, test: Rows) -> tuple[Array, Array]:
        presses = skin.select(train)
        places = learn_places(presses if design else replace(presses, design=None))
        located, _ = places.locator.locate(skin.ratios[test])
        return located.place, located.deviation

    def regression(
        make: Callable[[], Any], skin: LabelledPresses, train: Rows, test: Rows
    ) -> tuple[Array, Array]:
        """Regressor of scikit-learn on the logarithms of the ratios."""
        x = np.log(skin.ratios)
        scale = x[train].std(axis=0)
        fitted = make().fit(x[train] / scale, skin.places[train])
        return fitted.predict(x[test] / scale), np.full(len(test), np.nan)

    def mean(skin: LabelledPresses, train: Rows, test: Rows) -> tuple[Array, Array]:
        place = np.tile(skin.places[train].mean(axis=0), (len(test), 1))
        return place, np.full(len(test), np.nan)

    forest = partial(ensemble.ExtraTreesRegressor, 300, random_state=0)
    return {
        "maps with the design": partial(maps, True),
        "maps": partial(maps, False),
        "ExtraTrees": partial(regression, forest),
        "ridge": partial(regression, partial(linear.RidgeCV, np.logspace(-3, 3, 13))),
        "mean place": mean,
    }


def _mean_errors(errors: list[tuple[str, int, float, float]]) -> Iterator[tuple[str, float]]:
    """Means over the draws, by number of presses and method."""
    for method, count in dict.fromkeys((method, count) for method, count, *_ in errors):
        mine = np.array([error[2:] for error in errors if error[:2] == (method, count)])
        error, ratio = mine.mean(axis=0).tolist()
        yield f"{count} / {method}", error
        yield f"{count} / {method}, error over standard error", ratio


def judge_board_frame(path: Path) -> tuple[float, str]:
    """Size of another board's values over those that were trained with, and what is reported.

    The shipped pipeline refuses a frame whose values are not those of its sensor.
    """
    pipeline = Pipeline.load("reference.eitmodel")
    recording = read_recording(path, protocol=pipeline.layout.protocol)
    values = np.abs(recording.impedance[0])
    ratio = float(np.exp(np.median(np.log(values / pipeline.layout.reference))))
    try:
        pipeline.process(recording.frame(0))
    except FrameError as error:
        return ratio, f"refused: {error}"
    return ratio, "accepted"


def fit_tank(protocol: Protocol, readings: Array, mesh: Discretisation) -> Mapping[str, float]:
    """Relative residuals of the tank's readings: all, those of driven electrodes, the others.

    Fitted is one conductivity, by which all readings (measurements,) scale.
    """
    design = SensorDesign.from_toml(TANK)
    electrodes = (replace(e, contact_impedance=CONTACT_IMPEDANCE) for e in design.electrodes)
    model = ForwardModel(replace(design, electrodes=tuple(electrodes)), mesh)
    unit = protocol.measure(model.impedance()).real
    missed = float(unit @ readings) / float(unit @ unit) * unit - readings
    driven = np.array(protocol.shares)
    masks = {"all": np.ones_like(driven), "driven": driven, "others": ~driven}
    return {
        name: float(np.linalg.norm(missed[rows]) / np.linalg.norm(readings[rows]))
        for name, rows in masks.items()
    }
