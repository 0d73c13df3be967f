"""Leaderboard of skinbench: a JSON file of entries, made of the results of benchmarks alone."""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from eitskin.benchmarks.results import Results
from eitskin.benchmarks.skinbench.tracks import NAME, SEED, TRACKS, VERSION, Track, track_of
from eitskin.errors import ConfigurationError, DataError
from eitskin.files import atomic_file, read_bytes
from eitskin.provenance import Provenance

_MOST_BYTES = 1 << 24


@dataclass(frozen=True, slots=True)
class Entry:
    """Scores of one method on one track.

    Attributes:
        track: name of the track.
        name: of the method or the pipeline.
        scores: by their texts, in their units; what a method does not give is left out.
        command: that measured them.
        provenance: machine, versions, seed and date.
        frames: SHA-256 of the manifests of the frames; empty where that was not noted.
        code: SHA-256 of the file of a method of one's own; empty for others.
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
        entries: in the order of the tracks, the best first.
        benchmark, version: of the set that they were measured on.
    """

    entries: tuple[Entry, ...] = ()
    benchmark: str = NAME
    version: int = VERSION

    def with_results(
        self, results: Results, frames: str = "", codes: Mapping[str, str] | None = None
    ) -> "Leaderboard":
        """The same with the entries that results make; older ones of the same run are replaced.

        Args:
            results: of a benchmark that belongs to a track.
            frames: SHA-256 of the frames that they were measured on.
            codes: SHA-256 of the code of own methods, by their names.

        Raises ConfigurationError for results of other benchmarks, seeds, or quick runs.
        """
        new = tuple(_entries(results, frames, codes or {}))
        made = {each.run for each in new}
        kept = (each for each in self.entries if each.run not in made)
        return replace(self, entries=_ranked((*kept, *new)))

    def table(self, track: Track) -> str:
        """Markdown of the entries of a track."""
        heads = ("method", *(f"{score.text} [{score.unit}]" for score in track.scores))
        lines = ["| " + " | ".join((*heads, "eitskin", "date")) + " |"]
        lines.append("|---" * (len(heads) + 2) + "|")
        for each in self.entries:
            if each.track == track.name:
                cells = (_cell(each.scores.get(score.text), score.unit) for score in track.scores)
                made = (each.provenance.packages["eitskin"], each.provenance.date[:10])
                lines.append("| " + " | ".join((each.name, *cells, *made)) + " |")
        return "\n".join(lines) + "\n"


def read_leaderboard(path: Path) -> Leaderboard:
    """Leaderboard of a file, empty where there is none; raises DataError for another file."""
    if not path.exists():
        return Leaderboard()
    content = read_bytes(path, _MOST_BYTES, DataError)
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
    track = track_of(results.name)
    if track is None:
        names = ", ".join(each.results for each in TRACKS)
        raise ConfigurationError(f"{NAME} is made of results of {names}, got {results.name}")
    if results.quick or results.provenance.seed != SEED:
        raise ConfigurationError(
            f"{NAME} takes results of full runs with seed {SEED}, got seed "
            f"{results.provenance.seed}{', a quick run' if results.quick else ''}"
        )
    for name, scores in track.rows(results.figures):
        yield Entry(
            track.name,
            name,
            {text: round(value, 6) for text, value in scores.items()},
            results.command,
            results.provenance,
            frames,
            codes.get(name, ""),
        )


def _ranked(entries: tuple[Entry, ...]) -> tuple[Entry, ...]:
    """Entries by track, first score and date."""
    order = {track.name: number for number, track in enumerate(TRACKS)}
    first = {track.name: track.scores[0].text for track in TRACKS}

    def rank(entry: Entry) -> tuple[int, float, str, str]:
        value = entry.scores.get(first[entry.track], float("inf"))
        return order[entry.track], value, entry.name, entry.provenance.date

    return tuple(sorted(entries, key=rank))


def _cell(value: float | None, unit: str) -> str:
    digits = {"mm": 2, "deg": 2, "%": 1}[unit]
    return "" if value is None else f"{value:.{digits}f}"
