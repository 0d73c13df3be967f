"""Numbers and pictures that pages quote, held to what was measured: `eitskin bench quoted`.

`benchmarks/quoted/*.toml` says of each page which of its texts quote which figures:

    document = "README.md"
    results = "accuracy"        # of the quotes that follow, unless one names its own
    [spread.time]               # a number may differ from its figure by a factor or by a share
    factor = 2.0
    why = "times of one machine"
    [[quote]]
    text = "takes {46 = ours.frame_ms ~ time} ms on {11,100 = ours.nodes} nodes"
    [[table]]                   # of the document, as the report of the benchmark has it
    head = "| pair | -20 | -10 |"
    title = "Bends"             # heading of the table in the report
    spread = { "median ms" = "time" }
    [[picture]]                 # whose points, but for a share, are those of the one drawn
    file = "docs/signals.png"

Without a spread a number may differ by one unit of the last digit that is quoted.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec

from eitskin.benchmarks.markdown_tables import NUMBER, keyed, numbers, tables
from eitskin.errors import ConfigurationError

ROOT = Path(__file__).parent.parent
"""Of the checkout, whose documents are read."""
QUOTED = Path(__file__).parent / "quoted"

_MARKED = re.compile(r"\{([^{}=]+?) = ([^{}]+?)(?: ~ (\w+))?\}")


@dataclass(frozen=True, slots=True)
class Spread:
    """How far a number may be from its figure.

    Attributes:
        why: it may.
        factor: of more or less.
        share: of the figure.
    """

    why: str
    factor: float = 1.0
    share: float = 0.0

    def holds(self, quoted: float, measured: float, unit: float) -> bool:
        """Whether two numbers agree, at least up to one unit of the last digit quoted."""
        low, high = sorted((quoted / self.factor, quoted * self.factor))
        far = max(unit * (1.0 + 1e-9), self.share * abs(measured))
        return abs(quoted - measured) <= far or low <= measured <= high


ROUNDED = Spread("rounded")


@dataclass(frozen=True, slots=True)
class Number:
    """One number of a document and where it comes from.

    Attributes:
        document: its path.
        line: that it stands in.
        written: as it stands there.
        results, key: name of the results, and of the figure in them.
        spread: by which it may differ.
    """

    document: str
    line: int
    written: str
    results: str
    key: str
    spread: Spread


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture of a document, the results that have it too, and the share that may differ."""

    document: str
    file: str
    results: str
    name: str
    points: float


class Quote(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """A text in which numbers are marked `{written = key ~ spread}`."""

    text: str
    results: str = ""


class QuotedTable(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """A table of the document, the `nth` with this head; its cells are those of a report."""

    head: str
    title: str = ""
    nth: int = 1
    results: str = ""
    spread: dict[str, str] = {}


class QuotedPicture(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """A picture that a benchmark draws.

    Attributes:
        file: of the document.
        name: among the results, where it is another.
        results: name of those.
        points: share of them that may differ: marks of a time, and the edges of letters.
    """

    file: str
    name: str = ""
    results: str = ""
    points: float = 0.02


class Page(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """All that one document quotes."""

    document: str
    results: str = ""
    spread: dict[str, Spread] = {}
    quote: tuple[Quote, ...] = ()
    table: tuple[QuotedTable, ...] = ()
    picture: tuple[QuotedPicture, ...] = ()

    def pictures(self) -> Iterator[Picture]:
        """Every picture that is drawn by a benchmark."""
        for each in self.picture:
            name = each.name or Path(each.file).name
            results = each.results or self.results
            yield Picture(self.document, each.file, results, name, each.points)

    def numbers(self, root: Path = ROOT) -> Iterator[Number]:
        """Every number that is quoted; raises ConfigurationError where a quote does not stand."""
        text = (root / self.document).read_text(encoding="utf-8")
        for quote in self.quote:
            yield from self._of_quote(quote, text)
        for table in self.table:
            yield from self._of_table(table, text)

    def _of_quote(self, quote: Quote, text: str) -> Iterator[Number]:
        plain = _MARKED.sub(lambda match: match[1], quote.text)
        if text.count(plain) != 1:
            raise ConfigurationError(
                f"{self.document} was expected to say this once and does so {text.count(plain)} "
                f"times: {plain!r}; change the page or its file in benchmarks/quoted"
            )
        line = text[: text.index(plain)].count("\n") + 1
        for match in _MARKED.finditer(quote.text):
            written, key, spread = match.groups()
            yield self._number(line, written, quote.results, key, spread)

    def _of_table(self, quoted: QuotedTable, text: str) -> Iterator[Number]:
        lines = text.splitlines()
        places = [number for number, line in enumerate(lines) if line == quoted.head]
        if len(places) < quoted.nth:
            raise ConfigurationError(
                f"{self.document} has no table number {quoted.nth} headed {quoted.head!r}; "
                "change the page or its file in benchmarks/quoted"
            )
        place = places[quoted.nth - 1]
        (table, *_) = tables("\n".join(lines[place:]))
        width = len(table.head) - 1
        for count, (key, cell) in enumerate(table.cells()):
            line, column = place + 3 + count // width, table.head[1 + count % width]
            whole = f"{quoted.title} / {key}" if quoted.title else key
            spread = quoted.spread.get(column)
            for name, written in zip(keyed(whole, numbers(cell)), numbers(cell), strict=True):
                yield self._number(line, written, quoted.results, name, spread)

    def _number(
        self, line: int, written: str, results: str, key: str, spread: str | None
    ) -> Number:
        if not NUMBER.fullmatch(written):
            raise ConfigurationError(f"{self.document}: expected a number, got {written!r}")
        if spread is not None and spread not in self.spread:
            raise ConfigurationError(
                f"{self.document}: no spread {spread!r}; there are: {', '.join(self.spread)}"
            )
        allowed = ROUNDED if spread is None else self.spread[spread]
        return Number(self.document, line, written, results or self.results, key, allowed)


def pages(folder: Path = QUOTED) -> list[Page]:
    """All pages that quote something; raises ConfigurationError where a file is wrong."""
    found = []
    for path in sorted(folder.glob("*.toml")):
        try:
            found.append(msgspec.toml.decode(path.read_bytes(), type=Page))
        except msgspec.DecodeError as error:
            raise ConfigurationError(f"{path}: {error}") from error
    return found


def unit_of(written: str) -> float:
    """One of the last digit: 0.1 of 18.6, 1e-7 of 8.3e-6, 1 of 4,311."""
    mantissa, _, exponent = written.partition("e")
    digits = len(mantissa.partition(".")[2])
    return float(f"1e{int(exponent or 0) - digits}")
