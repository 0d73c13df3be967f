"""Pages of published results, and the figures that other pages quote: `make pages`.

The pages of `docs/results` show the main figures of `benchmarks/published/NAME/results.json`, and
the leaderboard: `sections.toml` in that folder says which. `quoted.toml` has the keys of the
figures in table rows of README and docs; they are written again with the page's digits.
"""

import re
import sys
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from eitskin.benchmarks.leaderboard import (
    TRACKS,
    leaderboard_page,
    read_leaderboard,
    write_leaderboard,
)
from eitskin.benchmarks.results import NUMBER, Results, found_results
from eitskin.geometry import ConfigurationError

ROOT = Path(__file__).resolve().parents[1]
PUBLISHED_FOLDER = ROOT / "benchmarks" / "published"


def full_results(folder: Path = PUBLISHED_FOLDER) -> dict[str, Results]:
    """Results of full runs by name; quick runs are left out."""
    return {result.name: result for result in found_results(folder) if not result.quick}


def result_section(
    results: Results,
    title: str,
    about: str = "",
    shown: str = ".*",
    names: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """Markdown of the figures of a benchmark, in tables of rows with the same columns.

    `about` explains them; `shown` is a pattern of "ROW | COLUMN"; `names` has words for both.
    """
    provenance = results.provenance
    machine = re.sub(r"\(R\)| Processor", "", provenance.machine)
    source = f"`{results.command}`, {machine}, {provenance.date[:10]}."
    lines = [f"## {title}", "", f"{about} {source}".strip()]
    for columns, rows in _tables(results.figures, re.compile(shown)):
        heads = " | ".join(names.get(column, column) for column in columns)
        lines += ["", f"| | {heads} |", "|---" * (len(columns) + 1) + "|"]
        for row, cells in rows.items():
            texts = (names.get(row, row), *(cells.get(column, "") for column in columns))
            lines.append(f"| {' | '.join(texts)} |")
    return "\n".join(lines) + "\n"


def with_figures(text: str, keys: Mapping[str, Sequence[str]], results: Results) -> str:
    """Page with the figures of some table rows as published.

    `keys` has the key of each number of a row after its first cell, empty for one that is no
    figure, by the text of that cell. Raises ConfigurationError where a row or figure is missing.
    """
    for label, row_keys in keys.items():
        rows = re.compile(rf"^\| {re.escape(label)} \|.*$", re.MULTILINE).findall(text)
        missing = {key for key in row_keys if key} - set(results.figures)
        if len(rows) != 1 or missing:
            raise ConfigurationError(
                f"expected one row {label!r} with figures of {results.name}, got {len(rows)} rows, "
                f"and no figures {sorted(missing)}; mend docs/results/quoted.toml"
            )
        head = len(f"| {label} |")
        cells, number = rows[0][head:], iter(row_keys)

        def publish_figure(match: re.Match[str], number: Iterator[str] = number) -> str:
            key = next(number, "")
            return rewritten(match[0], results.figures[key]) if key else match[0]

        text = text.replace(rows[0], rows[0][:head] + NUMBER.sub(publish_figure, cells))
    return text


def rewritten(written: str, value: float) -> str:
    """Value with as many decimals, and thousands marked, as the number that it replaces."""
    comma = "," if "," in written else ""
    return f"{value:{comma}.{len(written.partition('.')[2])}f}"


def pages(results: Mapping[str, Results], root: Path = ROOT) -> dict[Path, str]:
    """Text of every page that shows or quotes results, by its path."""
    folder = root / "docs" / "results"
    board = leaderboard_page(read_leaderboard(folder / "leaderboard.json"))
    contents = tomllib.loads((folder / "sections.toml").read_text(encoding="utf-8"))
    out = {}
    for name, sections in contents.items():
        title = sections.pop("title")
        versions = ", ".join({results[each].provenance.packages["eitskin"]: 0 for each in sections})
        source = "By `make pages`, from `benchmarks/published`; seed 0 if the command names none."
        parts = [f"# {title}\n\n{source} eitskin {versions}.\n"]
        parts += [result_section(results[each], **keys) for each, keys in sections.items()]
        out[folder / f"{name}.md"] = "\n".join([*parts, *([board] * (name == "pipeline"))])
    quoted = tomllib.loads((folder / "quoted.toml").read_text(encoding="utf-8"))
    for name, by_page in quoted.items():
        for page, keys in by_page.items():
            path = root / page
            text = out.get(path) or path.read_text(encoding="utf-8")
            out[path] = with_figures(text, keys, results[name])
    return out


def main(folders: Sequence[str]) -> None:
    """Write all pages of the published results, or of other runs where there are any."""
    results = full_results()
    for folder in folders:
        results |= full_results(Path(folder))
    path = ROOT / "docs" / "results" / "leaderboard.json"
    if not folders:
        board = read_leaderboard(path)
        for track in TRACKS:
            board = board.with_results(results[track.results])
        write_leaderboard(path, board)
    for page, text in pages(results).items():
        page.write_text(text, encoding="utf-8")


def _tables(
    figures: Mapping[str, float], shown: re.Pattern[str]
) -> list[tuple[list[str], dict[str, dict[str, str]]]]:
    """Columns and rows of each table; a row joins the last table that has half of its columns."""
    rows: dict[str, dict[str, str]] = {}
    for key, value in figures.items():
        parts = re.split(r"(?<=[a-z]): (?=\w)", key, maxsplit=1)[::-1]
        if len(parts) == 1:
            parts = list(key.rpartition(" / ")[::2])
        if not parts[0]:
            parts = list(key.rpartition(".")[::2])
        row = parts[0] or key
        column = parts[1] if parts[0] else "value"
        if shown.fullmatch(f"{row} | {column}") and not key.endswith("+-"):
            spread = f" ± {figures[f'{key} +-']:.2g}" if f"{key} +-" in figures else ""
            digits = ",.0f" if value >= 1e4 else ".4g"
            rows.setdefault(row, {})[column] = f"{value:{digits}}{spread}"
    tables: list[tuple[list[str], dict[str, dict[str, str]]]] = []
    for row, cells in rows.items():
        for columns, members in tables:
            if 2 * len(set(columns) & set(cells)) >= max(len(cells), len(columns) // 2):
                columns += [cell for cell in cells if cell not in columns]
                members[row] = cells
                break
        else:
            tables.append((list(cells), {row: cells}))
    return tables


if __name__ == "__main__":
    main(sys.argv[1:])
