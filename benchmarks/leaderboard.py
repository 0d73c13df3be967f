"""Leaderboard of skinbench: a JSON file of entries, made of the results of benchmarks alone.

A track is what is measured on which frozen frames. Their recipes stand in
`skinbench/recipes/TRACK`, as they were when the version was frozen; a test makes them again.
"""

import hashlib
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from eitskin.benchmarks.results import Results
from eitskin.benchmarks.transfer import WORLDS
from eitskin.files import atomic_file, read_bytes
from eitskin.geometry import ConfigurationError, DataError
from eitskin.provenance import Provenance

_MAX_BYTES = 1 << 24
NAME, VERSION = "skinbench", 2
_DIGITS = {"mm": 2, "deg": 2, "%": 1}
SEED = 0
_PAGE = f"""## {NAME}, version {VERSION}

A benchmark set for methods of electrical-impedance skin. One command makes the frames, trains
[your method](../how-to/own-method.md) and enters its scores into a file like
[leaderboard.json](leaderboard.json):

    eitskin bench paper --seeds 1 --paper-seeds 0 --method my.py:Net --leaderboard leaderboard.json

To use the frames of a track in your own code:

    eitskin generate benchmarks/skinbench/recipes/common/frames.toml --out common
    eitskin export parquet common --out skinbench

**Frozen.** Recipes are in `benchmarks/skinbench/recipes`, the seed is 0. Compare entries within
one version of eitskin. Quick runs and other seeds are refused.

**Scores.** A touch is detected within 15 mm of a true one, assigned one to one. Errors are means
over detected touches, false positives are per true touch, angles are RMS errors. An empty cell is
not estimated. The first score ranks.
"""
_WORLDS = "|".join(map(re.escape, WORLDS))


@dataclass(frozen=True, slots=True)
class Score:
    """Score of a track.

    Attributes:
        text: head of its column.
        unit: "mm", "deg", "%" or "ms".
        pattern: key of the figure; NAME stands for the method, WORLD for any world.
        more: whether more of it is better, which the worst of all worlds depends on.
        factor: factor from the figure to the unit.
    """

    text: str
    unit: str
    pattern: str
    more: bool = False
    factor: float = 1.0

    def values(self, figures: Mapping[str, float]) -> dict[str, float]:
        """Value of each method among the figures of a run; the worst where WORLD is in the key."""
        pattern = re.escape(self.pattern)
        pattern = pattern.replace("NAME", "(?P<name>[^,/]+)", 1).replace("WORLD", f"(?:{_WORLDS})")
        values_by_name: dict[str, list[float]] = {}
        for key, value in figures.items():
            match = re.fullmatch(pattern, key)
            if match:
                values_by_name.setdefault(match["name"].strip(), []).append(self.factor * value)
        worst = min if self.more else max
        return {name: worst(values) for name, values in values_by_name.items()}


@dataclass(frozen=True, slots=True)
class Track:
    """Track of skinbench.

    Attributes:
        name: name of the track.
        results: name of the benchmark whose results it is made of.
        about: question of the track, for its page.
        scores: the first ranks.
    """

    name: str
    results: str
    about: str
    scores: tuple[Score, ...]

    def rows(self, figures: Mapping[str, float]) -> Iterator[tuple[str, dict[str, float]]]:
        """Each method that has figures, and its scores by their texts."""
        values = {score.text: score.values(figures) for score in self.scores}
        names = dict.fromkeys(name for values in values.values() for name in values)
        for name in names:
            yield name, {text: values[name] for text, values in values.items() if name in values}


def _adaptation_scores(labelled: str, text: str) -> Iterator[Score]:
    start = f"NAME / WORLD, {labelled} / "
    yield Score(f"{text}: place", "mm", f"{start}place, mean [mm]")
    yield Score(f"{text}: found", "%", f"{start}touches found", more=True, factor=100.0)
    yield Score(f"{text}: angle", "deg", f"{start}angle, rms [deg]")


_UNSEEN_CONDITIONS = {
    "four touches: error": ("mm", "touch.4.error_mm"),
    "found": ("%", "touch.4.found"),
    "false": ("%", "touch.4.false"),
    "three: error": ("mm", "touch.3.error_mm"),
    "two: error": ("mm", "touch.2.error_mm"),
    "one: error": ("mm", "touch.1.error_mm"),
    "idle right": ("%", "state.idle"),
    "touch right": ("%", "state.touch"),
    "bend right": ("%", "state.bend"),
    "angle": ("deg", "bend.angle_deg"),
    "angle, calibrated": ("deg", "calibrated.angle_deg"),
}
_COMMON = {
    "touches: error": ("mm", "touches: error, mm"),
    "found": ("%", "found, %"),
    "false": ("%", "false, %"),
    "states right": ("%", "states right, %"),
    "angle": ("deg", "angle: RMSE, deg"),
}
TRACKS = (
    Track(
        "unseen",
        "paper",
        "States, angle and touches on unseen sensors, by `eitskin bench paper`. Your methods "
        "learn from one sensor, as the paper did.",
        tuple(
            Score(text, unit, f"NAME, unseen: {key}")
            for text, (unit, key) in _UNSEEN_CONDITIONS.items()
        ),
    ),
    Track(
        "common",
        "methods",
        "The same for methods that learn from the same frames of 32 sensors and are tested on 8 "
        "others, by `eitskin bench methods`.",
        tuple(Score(text, unit, f"NAME / {key}") for text, (unit, key) in _COMMON.items()),
    ),
    Track(
        "transfer",
        "transfer",
        "Sensors with other clamps, stiffness, electrodes and boards: the worst of five test "
        "conditions, as it is, and adapted by 5 angles and 15 touches. By `eitskin bench transfer "
        "my.eitmodel`.",
        (
            *_adaptation_scores("0 angles", "as it is"),
            *_adaptation_scores("5 angles, 15 presses", "adapted by 20"),
        ),
    ),
    Track(
        "real",
        "recordings",
        "Positions on a real round skin, learned from k of its first 400 touches and tested on its "
        "last 100. By `eitskin bench recordings DATA`.",
        tuple(Score(f"{k} presses", "mm", f"{k} / NAME") for k in (400, 200, 50, 20, 5)),
    ),
)


@dataclass(frozen=True, slots=True)
class Entry:
    """Scores of one method on one track.

    Attributes:
        track: name of the track.
        name: name of the method or the pipeline.
        scores: scores by their texts, in their units; what a method does not give is left out.
        command: command that measured them.
        provenance: machine, versions, seed and date.
        frames: SHA-256 of the manifests of the frames; empty where that was not noted.
        code: SHA-256 of the file of a custom method; empty for others.
    """

    track: str
    name: str
    scores: dict[str, float]
    command: str
    provenance: Provenance
    frames: str = ""
    code: str = ""

    @property
    def run(self) -> tuple[str, ...]:
        """Entries of which one replaces the other."""
        version = self.provenance.packages.get("eitskin", "")
        return self.track, self.name, self.command, version, self.code


@dataclass(frozen=True, slots=True)
class Leaderboard:
    """Entries of all tracks.

    Attributes:
        entries: entries in the order of the tracks, the best first.
        benchmark, version: set that they were measured on.
    """

    entries: tuple[Entry, ...] = ()
    benchmark: str = NAME
    version: int = VERSION

    def with_results(
        self, results: Results, frames: str = "", codes: Mapping[str, str] | None = None
    ) -> "Leaderboard":
        """The same with the entries that results make; older ones of the same run are replaced.

        `frames` and, by the names of own methods, `codes` are SHA-256 digests. Raises
        ConfigurationError for results of other benchmarks, seeds, or quick runs.
        """
        new = tuple(_entries(results, frames, codes or {}))
        new_runs = {each.run for each in new}
        other_entries = (entry for entry in self.entries if entry.run not in new_runs)
        return replace(self, entries=_rank_entries((*other_entries, *new)))

    def table(self, track: Track) -> str:
        """Markdown of the entries of a track."""
        heads = ("method", *(f"{score.text} [{score.unit}]" for score in track.scores))
        lines = ["| " + " | ".join((*heads, "eitskin")) + " |"]
        lines.append("|---" * (len(heads) + 1) + "|")
        for each in (entry for entry in self.entries if entry.track == track.name):
            cells = (
                f"{each.scores[score.text]:.{_DIGITS[score.unit]}f}"
                if score.text in each.scores
                else ""
                for score in track.scores
            )
            row = (each.name, *cells, each.provenance.packages["eitskin"])
            lines.append("| " + " | ".join(row) + " |")
        return "\n".join(lines) + "\n"


def read_leaderboard(path: Path) -> Leaderboard:
    """Leaderboard of a file, empty where there is none; raises DataError for another file."""
    if not path.exists():
        return Leaderboard()
    content = read_bytes(path, _MAX_BYTES, DataError)
    try:
        board = msgspec.json.decode(content, type=Leaderboard)
    except msgspec.DecodeError as error:
        raise DataError(f"{path} is no leaderboard: {error}; name another file") from error
    if (board.benchmark, board.version) != (NAME, VERSION):
        raise DataError(
            f"{path} is of {board.benchmark} {board.version}, expected {NAME} {VERSION}, whose "
            "frames differ; name another file"
        )
    return board


def write_leaderboard(path: Path, board: Leaderboard) -> None:
    """Write a leaderboard, whole; raises ConfigurationError where that fails."""
    with atomic_file(path) as temporary:
        content = msgspec.json.format(msgspec.json.encode(board), indent=1)
        temporary.write_bytes(content + b"\n")


def enter(path: Path, results: Results, folder: Path, codes: Mapping[str, str]) -> None:
    """Enter results into the leaderboard of a file, with the digests of frames and own methods.

    `folder` has the frames; `codes` are FILE.py:CLASS of own methods, by their names.
    """
    digests = {name: code_digest(code) for name, code in codes.items()}
    board = read_leaderboard(path).with_results(results, frames_digest(folder), digests)
    write_leaderboard(path, board)


def frames_digest(folder: Path) -> str:
    """SHA-256 of the manifests of all datasets in a folder, which name all files of frames."""
    total = hashlib.sha256()
    for path in sorted(folder.rglob("manifest.json")):
        total.update(path.relative_to(folder).as_posix().encode() + b"\n" + path.read_bytes())
    return total.hexdigest()


def code_digest(code: str) -> str:
    """SHA-256 of the file that FILE.py:CLASS names; empty for an installed method."""
    path = Path(code.rpartition(":")[0] or code)
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


def _entries(results: Results, frames: str, codes: Mapping[str, str]) -> Iterator[Entry]:
    tracks = {track.results: track for track in TRACKS}
    if results.name not in tracks:
        names = ", ".join(tracks)
        raise ConfigurationError(f"{NAME} is made of results of {names}, got {results.name}")
    if results.quick or results.provenance.seed != SEED:
        raise ConfigurationError(
            f"{NAME} takes results of full runs with seed {SEED}, got seed "
            f"{results.provenance.seed}{', a quick run' if results.quick else ''}"
        )
    track = tracks[results.name]
    for name, scores in track.rows(results.figures):
        rounded = {text: round(value, 6) for text, value in scores.items()}
        code, run = codes.get(name, ""), (results.command, results.provenance)
        yield Entry(track.name, name, rounded, *run, frames, code)


def _rank_entries(entries: tuple[Entry, ...]) -> tuple[Entry, ...]:
    """Entries by track, first score and date."""
    order = {track.name: number for number, track in enumerate(TRACKS)}
    first = {track.name: track.scores[0].text for track in TRACKS}

    def rank(entry: Entry) -> tuple[int, float, str, str]:
        value = entry.scores.get(first[entry.track], float("inf"))
        return order[entry.track], value, entry.name, entry.provenance.date

    return tuple(sorted(entries, key=rank))


def leaderboard_page(board: Leaderboard) -> str:
    """Markdown of the leaderboard: what it asks, and the table of each track."""
    parts = [_PAGE]
    for track in TRACKS:
        parts.append(f"### Track `{track.name}`\n\n{track.about}\n\n{board.table(track)}")
    return "\n".join(parts)
