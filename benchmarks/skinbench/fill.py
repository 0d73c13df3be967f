"""Leaderboard and its page from results of benchmarks, such as the published ones.

    python -m eitskin.benchmarks.skinbench.fill BOARD.json [--page PAGE.md] [RESULTS.json ...]

Adds the entries of each results.json to the leaderboard and, with a page, writes the table of each
track below its comment `<!-- leaderboard TRACK -->`.
"""

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

from eitskin.benchmarks.results import read_results
from eitskin.benchmarks.skinbench.leaderboard import (
    Leaderboard,
    read_leaderboard,
    write_leaderboard,
)
from eitskin.benchmarks.skinbench.tracks import TRACKS
from eitskin.errors import ConfigurationError
from eitskin.files import atomic_file

_TABLE = re.compile(r"^<!-- leaderboard (\w+) -->\n((?:\|.*\n)*)", re.MULTILINE)


def fill(board: Leaderboard, results: Sequence[Path]) -> Leaderboard:
    """The leaderboard with the entries of files of results; raises as `with_results` does."""
    for path in results:
        board = board.with_results(read_results(path))
    return board


def page_with(text: str, board: Leaderboard) -> str:
    """Page with the tables of the leaderboard; raises ConfigurationError for other tracks."""
    tracks = {track.name: track for track in TRACKS}

    def table(match: re.Match[str]) -> str:
        if match[1] not in tracks:
            raise ConfigurationError(
                f"expected a track of {', '.join(tracks)} in {match[0].splitlines()[0]}"
            )
        return f"<!-- leaderboard {match[1]} -->\n{board.table(tracks[match[1]])}"

    return _TABLE.sub(table, text)


def main(arguments: Sequence[str] | None = None) -> None:
    """Fill the files that the command line names."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("board", type=Path)
    parser.add_argument("results", type=Path, nargs="*")
    parser.add_argument("--page", type=Path)
    options = parser.parse_args(arguments)
    board = fill(read_leaderboard(options.board), options.results)
    write_leaderboard(options.board, board)
    if options.page is not None:
        text = page_with(options.page.read_text(encoding="utf-8"), board)
        with atomic_file(options.page) as temporary:
            temporary.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
