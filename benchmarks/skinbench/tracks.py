"""Tracks of skinbench: what is measured on which frozen frames, and the scores of each.

The recipes of the frames stand in `recipes/TRACK`, as they were when the version was frozen; a test
holds that the benchmarks still make these.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from eitskin.benchmarks.transfer.worlds import WORLDS

NAME, VERSION = "skinbench", 2
SEED = 0
RECORDING_SHA256 = "4bd805972f635f3e38884d42385b8b5a020c27abfc8f90550fdee9166d80c3a6"
"""Of `ohmc8.mat` (DSHardman/HydrogelEIT), the frames of the track `real`."""
_WORLDS = "|".join(map(re.escape, WORLDS))


@dataclass(frozen=True, slots=True)
class Score:
    """Score of a track.

    Attributes:
        text: what it is, as in the head of a column.
        unit: "mm", "deg", "%" or "ms".
        pattern: key of the figure; NAME stands for the method, WORLD for any world.
        more: whether more of it is better.
        factor: from the figure to the unit.
    """

    text: str
    unit: str
    pattern: str
    more: bool = False
    factor: float = 1.0

    def values(self, figures: Mapping[str, float]) -> dict[str, float]:
        """Value of each method among the figures of a run; the worst where WORLD is in the key."""
        wanted = re.escape(self.pattern)
        wanted = wanted.replace("NAME", "(?P<name>[^,/]+)", 1).replace("WORLD", f"(?:{_WORLDS})")
        found: dict[str, list[float]] = {}
        for key, value in figures.items():
            match = re.fullmatch(wanted, key)
            if match:
                found.setdefault(match["name"].strip(), []).append(self.factor * value)
        worst = min if self.more else max
        return {name: worst(values) for name, values in found.items()}


@dataclass(frozen=True, slots=True)
class Track:
    """Track of skinbench.

    Attributes:
        name: of the track.
        results: name of the benchmark whose results it is made of.
        scores: the first ranks.
    """

    name: str
    results: str
    scores: tuple[Score, ...]

    def rows(self, figures: Mapping[str, float]) -> Iterator[tuple[str, dict[str, float]]]:
        """Each method that has figures, and its scores by their texts."""
        values = {score.text: score.values(figures) for score in self.scores}
        names = dict.fromkeys(name for found in values.values() for name in found)
        for name in names:
            yield name, {text: found[name] for text, found in values.items() if name in found}


def _paper(figure: str) -> str:
    return f"NAME, unseen: {figure}"


def _adapted(labelled: str, text: str) -> Iterator[Score]:
    start = f"NAME / WORLD, {labelled} / "
    yield Score(f"{text}: place", "mm", f"{start}place, mean [mm]")
    yield Score(f"{text}: found", "%", f"{start}touches found", more=True, factor=100.0)
    yield Score(f"{text}: angle", "deg", f"{start}angle, rms [deg]")


TRACKS = (
    Track(
        "unseen",
        "paper",
        (
            Score("four touches: error", "mm", _paper("touch.4.error_mm")),
            Score("found", "%", _paper("touch.4.found"), more=True),
            Score("false", "%", _paper("touch.4.false")),
            Score("three: error", "mm", _paper("touch.3.error_mm")),
            Score("two: error", "mm", _paper("touch.2.error_mm")),
            Score("one: error", "mm", _paper("touch.1.error_mm")),
            Score("idle right", "%", _paper("state.idle"), more=True),
            Score("touch right", "%", _paper("state.touch"), more=True),
            Score("bend right", "%", _paper("state.bend"), more=True),
            Score("angle", "deg", _paper("bend.angle_deg")),
            Score("angle, calibrated", "deg", _paper("calibrated.angle_deg")),
        ),
    ),
    Track(
        "common",
        "methods",
        (
            Score("touches: error", "mm", "NAME / touches: error, mm"),
            Score("found", "%", "NAME / found, %", more=True),
            Score("false", "%", "NAME / false, %"),
            Score("states right", "%", "NAME / states right, %", more=True),
            Score("angle", "deg", "NAME / angle: RMSE, deg"),
        ),
    ),
    Track(
        "transfer",
        "transfer",
        (*_adapted("0 angles", "as it is"), *_adapted("5 angles, 15 presses", "adapted by 20")),
    ),
    Track(
        "real",
        "adaptation",
        tuple(Score(f"{k} presses", "mm", f"{k} / NAME") for k in (400, 200, 50, 20, 5)),
    ),
)


def track_of(results: str) -> Track | None:
    """Track that the results of a benchmark belong to; None where there is none."""
    return next((track for track in TRACKS if track.results == results), None)
