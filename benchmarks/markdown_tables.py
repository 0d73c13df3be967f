"""Tables in Markdown, of reports and pages, and the numbers in them."""

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

NUMBER = re.compile(r"[-+]?(?:\d{1,3}(?:,\d{3})+|\d+)(?:\.\d+)?(?:e[-+]?\d+)?")
_RULE = re.compile(r"\|(\s*:?-+:?\s*\|)+")
_ITEM = re.compile(r"- (.+?): (.+)")


@dataclass(frozen=True, slots=True)
class MarkdownTable:
    """Table in Markdown.

    Attributes:
        title: the heading or bold line above it, if there is one since the table before.
        head: of the columns.
        rows: cells under the head.
    """

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def labels(self) -> list[str]:
        """Labels of the rows: the first cell, with the second where that is a name as well.

        Rows that are still called the same are numbered.
        """
        firsts = [row[0] for row in self.rows]
        if len(set(firsts)) == len(firsts):
            return firsts
        seconds = [row[1] for row in self.rows]
        both = [", ".join(pair) for pair in zip(firsts, seconds, strict=True)]
        named = all(cell and not NUMBER.fullmatch(cell) for cell in seconds)
        if named and len(set(both)) == len(both):
            return both
        seen: Counter[str] = Counter()
        names = []
        for first in firsts:
            seen[first] += 1
            names.append(f"{first} ({seen[first]})" if seen[first] > 1 else first)
        return names

    def cells(self) -> Iterator[tuple[str, str]]:
        """Key `title / row / column` and text of every cell but the rows' first."""
        for label, row in zip(self.labels(), self.rows, strict=True):
            for column, cell in list(zip(self.head, row, strict=True))[1:]:
                yield " / ".join(filter(None, (self.title, label, column))), cell


def tables(text: str) -> list[MarkdownTable]:
    """All tables of a text in turn."""
    found: list[MarkdownTable] = []
    title = ""
    lines = text.splitlines()
    for number, line in enumerate(lines):
        if line.startswith(("#", "**")):
            title = line.strip("#* ")
        elif number and _RULE.fullmatch(line.strip()):
            head = _cells(lines[number - 1])
            rows = []
            for below in lines[number + 1 :]:
                if not below.startswith("|"):
                    break
                rows.append(_cells(below))
            found.append(MarkdownTable(title, head, tuple(rows)))
            title = ""
    return found


def figures(text: str) -> dict[str, float]:
    """Numbers in the tables of a report, and in its items `- what: number`, by their keys.

    The second and further numbers of a cell have keys that end in ` #2` and so on.
    """
    found: dict[str, float] = {}
    for table in tables(text):
        for key, cell in table.cells():
            found |= keyed(key, numbers(cell))
    for line in text.splitlines():
        if item := _ITEM.fullmatch(line):
            found |= keyed(item[1], numbers(item[2]))
    return found


def numbers(cell: str) -> list[str]:
    """Numbers of a cell as written, in order."""
    return NUMBER.findall(cell)


def keyed(key: str, written: Sequence[str]) -> dict[str, float]:
    """Values of numbers by their keys."""
    return {
        f"{key} #{place}" if place > 1 else key: value_of(text)
        for place, text in enumerate(written, 1)
    }


def value_of(written: str) -> float:
    """Value of a number as written; commas separate thousands."""
    return float(written.replace(",", ""))


def _cells(line: str) -> tuple[str, ...]:
    return tuple(cell.strip() for cell in line.strip().strip("|").split("|"))
