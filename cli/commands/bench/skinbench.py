"""Option `--leaderboard` of benchmarks that are tracks of skinbench."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from eitskin.errors import ConfigurationError

if TYPE_CHECKING:
    from eitskin.benchmarks.skinbench.leaderboard import Leaderboard

LeaderboardFile = Annotated[
    Path | None,
    typer.Option(help="Also enter the scores into this leaderboard of skinbench, a JSON file."),
]


@dataclass(frozen=True, slots=True)
class OpenLeaderboard:
    """Leaderboard that a run is entered into, and its file."""

    path: Path
    board: "Leaderboard"


def opened(path: Path | None, quick: bool, seed: int = 0) -> OpenLeaderboard | None:
    """Leaderboard of a file, before the work; None where none is named.

    Raises ConfigurationError where the run would be no entry, DataError for another file.
    """
    if path is None:
        return None
    from eitskin.benchmarks.skinbench.leaderboard import read_leaderboard
    from eitskin.benchmarks.skinbench.tracks import SEED

    if quick or seed != SEED:
        raise ConfigurationError(
            f"a leaderboard takes full runs with seed {SEED}; leave --quick and --seed out, or "
            "--leaderboard"
        )
    return OpenLeaderboard(path, read_leaderboard(path))


def entered(
    opened: OpenLeaderboard | None, folder: Path, codes: Mapping[str, str] | None = None
) -> list[Path]:
    """Enter the results in a folder; returns the path of the leaderboard where there is one.

    Args:
        opened: the leaderboard.
        folder: of the results and of the frames that they were measured on.
        codes: FILE.py:CLASS of own methods, by their names.
    """
    if opened is None:
        return []
    from eitskin.benchmarks.results import RESULTS, read_results
    from eitskin.benchmarks.skinbench.leaderboard import (
        code_digest,
        frames_digest,
        write_leaderboard,
    )

    made = {name: code_digest(code) for name, code in (codes or {}).items()}
    results = read_results(folder / RESULTS)
    new = opened.board.with_results(results, frames_digest(folder), made)
    write_leaderboard(opened.path, new)
    return [opened.path]
