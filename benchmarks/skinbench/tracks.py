"""Tracks of skinbench: what is measured on which frozen frames, and the scores of each."""

import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from eitskin.benchmarks.paper import sets as paper_sets
from eitskin.benchmarks.transfer import worlds
from eitskin.datasets.recipe.recipe import Recipe

NAME, VERSION = "skinbench", 1
SEED = 0
_WORLDS = "|".join(map(re.escape, worlds.WORLDS))


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
        digest: SHA-256 that the frames are frozen by: of their recipes, or of a recording.
    """

    name: str
    results: str
    scores: tuple[Score, ...]
    digest: str

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
        "88caf44bb52f00a3f10ff9d38ba17a2a2510e31d72ce3ae496dc100a1a211225",
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
        "eecd96faec464dca376b4f1dd77ca875e4d078e0da853daaac9254cca4bb5732",
    ),
    Track(
        "transfer",
        "transfer",
        (*_adapted("0 angles", "as it is"), *_adapted("5 angles, 15 presses", "adapted by 20")),
        "d2632e8ab4dc3ed95e32c4a444e38d3873bf6e4417967e00c014bc7bd4374924",
    ),
    Track(
        "real",
        "adaptation",
        tuple(Score(f"{k} presses", "mm", f"{k} / NAME") for k in (400, 200, 50, 20, 5)),
        "4bd805972f635f3e38884d42385b8b5a020c27abfc8f90550fdee9166d80c3a6",
    ),
)


def track_of(results: str) -> Track | None:
    """Track that the results of a benchmark belong to; None where there is none."""
    return next((track for track in TRACKS if track.results == results), None)


def recipes(track: str) -> dict[str, Recipe]:
    """Recipes of the frames that a track is measured on; none where it has none here."""
    if track == "unseen":
        return dict(paper_sets.recipes(SEED, quick=False))
    if track == "transfer":
        made = (each for world in worlds.WORLDS for each in worlds.recipes(world, SEED, False))
        return {recipe.name: recipe for recipe in made}
    return {}


def digest(made: Mapping[str, Recipe] | Iterable[tuple[str, Recipe]]) -> str:
    """SHA-256 of recipes by their names."""
    total = hashlib.sha256()
    for name, recipe in sorted(dict(made).items()):
        total.update(f"{name}\n{recipe.to_toml()}\n".encode())
    return total.hexdigest()
