"""Terminal on which no text of a file, a board or a pipeline acts as a command."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from rich import box
from rich.console import Console, ConsoleOptions, JustifyMethod, RenderableType
from rich.markup import escape
from rich.segment import Segment
from rich.table import Column, Table
from rich.text import Text

from eitskin.files import visible


class Terminal(Console):
    """Console that shows control characters of what it prints; colours are its own."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Segments of what is printed, in which all text is printable."""
        for segment in super().render(renderable, options):
            if segment.control or segment.text.isprintable():
                yield segment
            else:
                yield Segment(visible(segment.text), segment.style)

    def render_str(self, text: str, **options: Any) -> Text:
        """Text of a string, as wide as it is shown."""
        return super().render_str(visible(text), **options)


def make_table(
    headings: Iterable[str | Column], rows: Iterable[Sequence[str]], **look: Any
) -> Table:
    """Table of rows of cells, with options of Rich's `Table`."""
    table = Table(*headings, **look)
    for cells in rows:
        table.add_row(*cells)
    return table


@dataclass(frozen=True, slots=True, eq=False)
class FigureTable:
    """Table of figures, which goes on below where the terminal is too narrow for all columns.

    Attributes:
        headings: headings of the columns.
        rows: cells of each row.
        names: number of first columns that name a row, and begin every part.
    """

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    names: int = 1

    def __rich_console__(
        self, console: Console, options: ConsoleOptions
    ) -> Iterator[RenderableType]:
        """Parts of as many columns as fit, at least one each."""
        start, count = self.names, len(self.headings)
        while start < count:
            end = start + 1
            while end < count and self._width(console, start, end + 1) <= options.max_width:
                end += 1
            yield self._part(start, end)
            start = end

    def _width(self, console: Console, start: int, end: int) -> int:
        unbounded = console.options.update(width=10_000)
        return console.measure(self._part(start, end), options=unbounded).maximum

    def _part(self, start: int, end: int) -> Table:
        table = Table(box=box.SIMPLE, pad_edge=False)
        for number in (*range(self.names), *range(start, end)):
            justify: JustifyMethod = "left" if number < self.names else "right"
            table.add_column(escape(self.headings[number]), justify=justify)
        for row in self.rows:
            table.add_row(*map(escape, (*row[: self.names], *row[start:end])))
        return table
