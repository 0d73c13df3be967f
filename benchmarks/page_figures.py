"""Figures in pages, rendered from published results: `make figures`.

A comment in a page says where its numbers come from; each is written again from
`benchmarks/published/NAME/results.json`, with as many digits as stand in the page. Above a table:

    <!-- figures: cramer_rao: bend angle / ROW / COLUMN -->
    <!-- figures: accuracy | ROW.unknowns | ROW.frame_ms | | bent and pressed, ROW -->

The first form gives the figure of every cell, and just `<!-- figures: NAME -->` means ROW / COLUMN.
The second has a pattern for each column after the first, empty where a column has no figures.
ROW is the first cell of the row, or a comment in that cell: `10 N <!-- at once -->`; COLUMN is the
head of the column. Several numbers of one cell are the figures KEY, KEY #2, and so on, unless its
pattern or its row comment has several keys, `<!-- a; b -->`. A row `<!-- - -->` has no figures.

In prose a comment follows the numbers, one key for each of the last ones, `-` for a number that is
no figure and `#2` for the second number of the key before:

    takes 30 ms, 14 times as long<!-- speed: floor.ms; floor.times_longer -->
"""

import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from eitskin.benchmarks.leaderboard import TRACKS, page_with, read_leaderboard, write_leaderboard
from eitskin.benchmarks.results import NUMBER, Results, found_results, row_labels
from eitskin.errors import ConfigurationError

ROOT = Path(__file__).resolve().parents[1]
PUBLISHED = ROOT / "benchmarks" / "published"
_TABLE = re.compile(r"^<!-- figures: (\w+)(?:: (.+?)| (\|.*?))? -->\n((?:\|.*\n)+)", re.MULTILINE)
_ABOVE_TABLE = re.compile(r"^<!-- figures: ", re.MULTILINE)
_PROSE = re.compile(r"<!-- (?!figures: )(\w+): (.+?) -->")
_CODE = re.compile(r"(?:^ {4}.*\n?)+", re.MULTILINE)
_ROW_COMMENT = re.compile(r"<!-- ((?:(?!-->).)*) -->\s*$")
_IN_PROSE = re.compile(r"(?<![\w.])" + NUMBER.pattern)
_NO_FIGURE = "-"


@dataclass(frozen=True, slots=True)
class Figure:
    """Figure: a number of a page and its source.

    Attributes:
        start, end: position in the text.
        written: the number as it stands in the page.
        results, key: name of the results, and of the figure among them.
    """

    start: int
    end: int
    written: str
    results: str
    key: str


def pages(root: Path = ROOT) -> list[Path]:
    """Paths of the README, the page on security and all pages of docs."""
    first = (root / "README.md", root / "SECURITY.md")
    return [*filter(Path.is_file, first), *sorted((root / "docs").rglob("*.md"))]


def figures_in(text: str) -> list[Figure]:
    """All figures of a page in order; raises ConfigurationError where comments do not fit."""
    text = _CODE.sub(lambda code: " " * len(code[0]), text)  # examples of comments name no figures
    found = [each for match in _TABLE.finditer(text) for each in _of_table(match)]
    found += [each for match in _PROSE.finditer(text) for each in _of_prose(text, match)]
    if len(_ABOVE_TABLE.findall(text)) != len(_TABLE.findall(text)):
        raise ConfigurationError(
            "expected a table in the line after each comment `<!-- figures: ... -->`, "
            "got another line; move the comment right above its table"
        )
    return sorted(found, key=lambda each: each.start)


def rendered(text: str, published: Mapping[str, Results]) -> str:
    """Page with all its figures as published; raises ConfigurationError where one is missing."""
    parts, done = [], 0
    for each in figures_in(text):
        parts += [text[done : each.start], _formatted(each, published)]
        done = each.end
    return "".join([*parts, text[done:]])


def rewritten(written: str, value: float) -> str:
    """Value in the notation of the number it replaces: digits, sign, thousands, exponent."""
    mantissa, has_exponent, exponent = written.partition("e")
    digits = len(mantissa.partition(".")[2])
    sign = "+" if written.startswith("+") else ""
    if not has_exponent:
        comma = "," if "," in written else ""
        return f"{value:{sign}{comma}.{digits}f}"
    mantissa, _, power = f"{value:{sign}.{digits}e}".partition("e")
    return f"{mantissa}e{power if len(exponent) == len(power) else int(power)}"


def full_results(folder: Path = PUBLISHED) -> dict[str, Results]:
    """Results of full runs by name; quick runs are left out."""
    return {each.name: each for each in found_results(folder) if not each.quick}


def main(folders: Sequence[str]) -> None:
    """Write all pages with the published figures, or with those of other runs where there are any.

    Args:
        folders: of other runs, such as build/bench; `git diff` then shows what they change.
    """
    results = full_results()
    for folder in folders:
        results |= full_results(Path(folder))
    for page in pages():
        text = page.read_text(encoding="utf-8")
        new = rendered(text, results)
        if new != text:
            page.write_text(new, encoding="utf-8")
            print(f"changed: {page.relative_to(ROOT)}")
    path = ROOT / "docs" / "leaderboard.json"
    if not folders and path.is_file():
        board = read_leaderboard(path)
        for track in TRACKS:
            board = board.with_results(results[track.results])
        write_leaderboard(path, board)
        page = path.with_suffix(".md")
        page.write_text(page_with(page.read_text(encoding="utf-8"), board), encoding="utf-8")


def _of_table(match: re.Match[str]) -> Iterator[Figure]:
    results, whole, by_column, text = match.groups()
    lines = text.splitlines(keepends=True)
    columns, _, *rows = ([cell.strip() for cell in line.strip("|\n").split("|")] for line in lines)
    patterns = [cell.strip() for cell in by_column.split("|")[1:]] if by_column else []
    patterns = patterns or [whole or "ROW / COLUMN"] * (len(columns) - 1)
    if len(patterns) != len(columns) - 1:
        raise ConfigurationError(
            f"expected {len(columns) - 1} patterns, one for each column after the first, got "
            f"{len(patterns)} in {match[0].partition(chr(10))[0]}"
        )
    start = match.start(4) + len(lines[0]) + len(lines[1])
    for line, label in zip(lines[2:], row_labels(rows), strict=True):
        cells = list(re.finditer(r"(?<=\|)[^|\n]*(?=\|)", line))
        comment = _ROW_COMMENT.search(cells[0][0])
        names = (comment[1] if comment else label).split("; ")
        for cell, pattern, column in zip(cells[1:], patterns, columns[1:], strict=True):
            keys = [
                each.replace("ROW", name).replace("COLUMN", column)
                for name in names
                for each in pattern.split("; ")
            ]
            if pattern and names != [_NO_FIGURE]:
                yield from _of_cell(cell, keys, start, results)
        start += len(line)


def _of_cell(
    cell: re.Match[str], keys: Sequence[str], offset: int, results: str
) -> Iterator[Figure]:
    """Figures of one cell in the order of its keys, of which there may be more."""
    for count, number in enumerate(NUMBER.finditer(cell[0])):
        several = len(keys) > 1
        if several and count >= len(keys):
            raise ConfigurationError(f"expected a key for each number of {cell[0]!r}, got {keys}")
        key = keys[count] if several else keys[0] + (f" #{count + 1}" if count else "")
        first = offset + cell.start()
        yield Figure(first + number.start(), first + number.end(), number[0], results, key)


def _of_prose(text: str, match: re.Match[str]) -> Iterator[Figure]:
    results, keys = match[1], match[2].split("; ")
    begin = text.rfind("\n\n", 0, match.start()) + 1
    numbers = list(_IN_PROSE.finditer(text, begin, match.start()))[-len(keys) :]
    if len(numbers) != len(keys):
        raise ConfigurationError(f"expected {len(keys)} numbers before {match[0]}")
    key = ""
    for number, given in zip(numbers, keys, strict=True):
        if given == _NO_FIGURE:
            continue
        key = f"{key.partition(' #')[0]} {given}" if given.startswith("#") else given
        yield Figure(number.start(), number.end(), number[0], results, key)


def _formatted(figure: Figure, published: Mapping[str, Results]) -> str:
    results = published.get(figure.results)
    if results is None or figure.key not in results.figures:
        raise ConfigurationError(
            f"expected the figure {figure.key!r} of {figure.results} for {figure.written}, got "
            f"none; publish its results, or change the comment of the page"
        )
    return rewritten(figure.written, results.figures[figure.key])


if __name__ == "__main__":
    main(sys.argv[1:])
