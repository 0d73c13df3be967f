"""Errors of places on a real skin against the number of labelled presses.

Run by `python -m eitskin.benchmarks.recordings.adaptation FOLDER [--out OUT]`.

FOLDER holds `ohmc8.mat` (DSHardman/HydrogelEIT): 500 presses of a round skin in the order of time.
Each method learns from k random presses of the first 400 and finds the places of the last 100;
errors are means over seven draws (k = 400 has one). Maps know nothing of the sensor, maps with the
design its outline, electrodes and protocol; beside them stand ExtraTrees and ridge regression on
the logarithms of the ratios, and the mean of the labelled places. With `--tested-until 400` all of
it is done with the first 300 for learning and the presses from 300 to 400 for testing, by which
the method was made. Writes results and a plot, and prints the table as Markdown.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.results import Results, write_results
from eitskin.datasets.recordings.form import RecordingForm, RecordingNames
from eitskin.datasets.recordings.recording import read_recording
from eitskin.extras import require
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol
from eitskin.provenance import Provenance
from eitskin.training.adaptation.press_fit import LabelledPresses, learn_places

Array = NDArray[np.float64]
Method = Callable[[LabelledPresses, NDArray[np.int64], NDArray[np.int64]], tuple[Array, Array]]

NAME, RECORDING = "adaptation", "ohmc8.mat"
DESCRIPTIONS = Path(__file__).parents[2] / "docs" / "guides" / "recordings"
COUNTS = (5, 20, 50, 200, 400)
DRAWS, TESTED = 7, 100


def read_skin(folder: Path) -> LabelledPresses:
    """The presses of the recording in a folder."""
    design = SensorDesign.from_toml(DESCRIPTIONS / "round-skin.toml")
    names = RecordingNames(
        "responsedowns", "responseups", "positions", columns={"depth": "positions:2"}
    )
    protocol = Protocol.from_file(DESCRIPTIONS / "round-skin.csv", 8)
    form = RecordingForm(origin="centre")
    recording = read_recording(folder / RECORDING, names, protocol, design=design, form=form)
    return LabelledPresses.of(recording)


def maps(design: bool) -> Method:
    """Maps of the channels, with or without the sensor's design."""

    def learned(
        skin: LabelledPresses, train: NDArray[np.int64], test: NDArray[np.int64]
    ) -> tuple[Array, Array]:
        presses = skin.select(train)
        places = learn_places(presses if design else replace(presses, design=None))
        found, _ = places.locator.locate(skin.ratios[test])
        return found.place, found.deviation

    return learned


def regression(make: Callable[[int], Any]) -> Method:
    """Regressor of scikit-learn on the logarithms of the ratios."""

    def learned(
        skin: LabelledPresses, train: NDArray[np.int64], test: NDArray[np.int64]
    ) -> tuple[Array, Array]:
        x, rows = np.log(skin.ratios), len(test)
        scale = x[train].std(axis=0)
        fitted = make(len(train)).fit(x[train] / scale, skin.places[train])
        return fitted.predict(x[test] / scale), np.full(rows, np.nan)

    return learned


def mean_place(
    skin: LabelledPresses, train: NDArray[np.int64], test: NDArray[np.int64]
) -> tuple[Array, Array]:
    """The mean of the labelled places, whatever the frame."""
    return np.tile(skin.places[train].mean(axis=0), (len(test), 1)), np.full(len(test), np.nan)


def methods() -> dict[str, Method]:
    """All methods by name."""
    ensemble, linear = (
        require(f"sklearn.{name}", "training") for name in ("ensemble", "linear_model")
    )
    return {
        "maps with the design": maps(True),
        "maps": maps(False),
        "ExtraTrees": regression(lambda _: ensemble.ExtraTreesRegressor(300, random_state=0)),
        "ridge": regression(lambda _: linear.RidgeCV(np.logspace(-3, 3, 13))),
        "mean place": mean_place,
    }


def rows(
    skin: LabelledPresses, until: int, draws: int, counts: tuple[int, ...]
) -> Iterator[dict[str, Any]]:
    """Errors [mm] of each method, number of presses and draw, as they are made."""
    first = until - TESTED
    test = np.arange(first, until)
    for count in counts:
        for draw in range(draws if count < first else 1):
            order = np.random.default_rng(draw).permutation(first)
            train = np.sort(order[:count])
            for name, method in methods().items():
                began = time.process_time()
                place, deviation = method(skin, train, test)
                error = np.linalg.norm(place - skin.places[test], axis=1)
                yield {
                    "method": name,
                    "presses": min(count, first),
                    "draw": draw,
                    "error_mm": 1e3 * float(error.mean()),
                    "median_mm": 1e3 * float(np.median(error)),
                    "error_ratio": float(np.sqrt(np.mean((error / deviation) ** 2))),
                    "cpu_s": time.process_time() - began,
                }


def figures(found: list[dict[str, Any]]) -> dict[str, float]:
    """Means over the draws, by number of presses and method."""
    named: dict[str, float] = {}
    for name in methods():
        for count in sorted({row["presses"] for row in found}):
            mine = [row for row in found if (row["method"], row["presses"]) == (name, count)]
            named[f"{count} / {name}"] = float(np.mean([row["error_mm"] for row in mine]))
            ratio = float(np.mean([row["error_ratio"] for row in mine]))
            named[f"{count} / {name}, error over standard error"] = ratio
            named[f"{count} / {name}, CPU [s]"] = float(np.median([row["cpu_s"] for row in mine]))
    return named


def plot(found: list[dict[str, Any]], path: Path) -> None:
    """Draw the errors against the number of presses, and the standard errors' truth."""
    pyplot = require("matplotlib.pyplot", "training")
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(9.6, 4.0), layout="constrained")
    for name in methods():
        counts = sorted({row["presses"] for row in found})
        mine = [[r for r in found if (r["method"], r["presses"]) == (name, k)] for k in counts]
        errors = [[row["error_mm"] for row in each] for each in mine]
        middle = [np.mean(each) for each in errors]
        (line,) = left.plot(counts, middle, "o-", ms=4, lw=1.4, label=name)
        low, high = [min(each) for each in errors], [max(each) for each in errors]
        left.fill_between(counts, low, high, color=line.get_color(), alpha=0.12, lw=0)
        ratio = [np.mean([row["error_ratio"] for row in each]) for each in mine]
        if np.isfinite(ratio).all():
            right.plot(counts, ratio, "o-", ms=4, lw=1.4, color=line.get_color(), label=name)
    left.set(xscale="log", yscale="log", xlabel="labelled presses", ylabel="mean error [mm]")
    left.set_yticks([1, 2, 3, 5, 10, 20, 50], ["1", "2", "3", "5", "10", "20", "50"])
    right.axhspan(1 / 1.3, 1.3, color="0.9", lw=0)
    right.axhline(1.0, color="0.5", lw=0.8)
    right.set(xscale="log", xlabel="labelled presses", ylim=(0, 3))
    right.set_ylabel("rms of error over standard error")
    for axes in (left, right):
        axes.set_xticks(counts, [str(k) for k in counts])
        axes.minorticks_off()
        axes.spines[["top", "right"]].set_visible(False)
    left.legend(fontsize=8, frameon=False)
    figure.savefig(path, dpi=150, format="png")
    pyplot.close(figure)


def main() -> None:
    """Run, write and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help=f"where {RECORDING} is")
    parser.add_argument("--out", type=Path, default=Path("build/bench"))
    parser.add_argument("--draws", type=int, default=DRAWS)
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS)
    parser.add_argument("--tested-until", type=int, default=500)
    options = parser.parse_args()
    if not (options.folder / RECORDING).is_file():
        parser.error(
            f"there is no {options.folder / RECORDING}; it is of the repository "
            "DSHardman/HydrogelEIT"
        )
    began, found = time.perf_counter(), []
    skin = read_skin(options.folder)
    for row in rows(skin, options.tested_until, options.draws, tuple(options.counts)):
        print(
            f"{row['presses']:4d} {row['draw']} {row['method']:22s} {row['error_mm']:6.2f} mm, "
            f"ratio {row['error_ratio']:5.2f}, {row['cpu_s']:.1f} s",
            flush=True,
        )
        found.append(row)
    named = figures(found)
    quick = (options.draws, tuple(options.counts), options.tested_until) != (DRAWS, COUNTS, 500)
    command = f"python -m {__spec__.name if __spec__ else __name__} DATA"
    results = Results(NAME, command, Provenance.now(0), time.perf_counter() - began, quick, named)
    write_results(results, options.out, found, {"adaptation.png": lambda path: plot(found, path)})
    names = list(methods())
    print(f"\n| presses | {' | '.join(names)} |\n|{' --- |' * (1 + len(names))}")
    for count in sorted({row["presses"] for row in found}):
        cells = [f"{named[f'{count} / {name}']:.1f}" for name in names]
        print(f"| {count} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
