"""Measurement protocol: drive and sense electrodes of each measurement."""

import contextlib
import csv
import io
import itertools
import os
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.bounds import MOST_ELECTRODES, require_count
from eitskin.errors import ConfigurationError, FrameError
from eitskin.extras import old_names
from eitskin.files import atomic_file, read_text, shorten_text

Row: TypeAlias = tuple[int, int, int, int]

HEADER = ("drive_plus", "drive_minus", "sense_plus", "sense_minus")
MAX_ELECTRODES = 255  # on the wire the number of electrodes is a byte


@old_names(abbreviated="short_name", named="from_name")
@dataclass(frozen=True, slots=True)
class Protocol:
    """Table of measurements, each (drive+, drive-, sense+, sense-).

    Attributes:
        table: electrode numbers, one row per measurement.
        n_electrodes: number of electrodes of the sensor.

    Example:
        >>> from eitskin import Protocol
        >>> len(Protocol.pairwise(8).table), len(Protocol.adjacent(16).table)
        (28, 208)
    """

    table: tuple[Row, ...]
    n_electrodes: int

    def __post_init__(self) -> None:
        """Check that every row names electrodes that exist and two different ones per pair."""
        if not self.table:
            raise ConfigurationError("a protocol needs at least one measurement, got none")
        for number, row in enumerate(self.table):
            _check(row, self.n_electrodes, f"measurement {number}")

    @classmethod
    def pairwise(cls, n_electrodes: int) -> "Protocol":
        """Two-terminal measurements of all pairs of electrodes: (0,1), (0,2) ... in order."""
        require_count("n_electrodes", max(n_electrodes, 0), 0, MOST_ELECTRODES)
        pairs = itertools.combinations(range(n_electrodes), 2)
        return cls(tuple((i, j, i, j) for i, j in pairs), n_electrodes)

    @classmethod
    def skip(
        cls, n_electrodes: int, skip: int, sense_skip: int | None = None, shared: bool = False
    ) -> "Protocol":
        """Skip protocol: pairs (i, i + skip + 1) around the rim.

        Every drive pair is combined with every sense pair.

        Args:
            n_electrodes: number of electrodes of the sensor.
            skip: electrodes left out between drive+ and drive-.
            sense_skip: electrodes left out between sense+ and sense-; `skip` when omitted.
            shared: keep sense pairs that share an electrode with the drive pair, whose voltages
                contain that electrode's contact impedance.
        """
        require_count("n_electrodes", max(n_electrodes, 0), 0, MOST_ELECTRODES)
        drives = _ring_pairs(n_electrodes, skip)
        senses = _ring_pairs(n_electrodes, skip if sense_skip is None else sense_skip)
        table = tuple(d + s for d in drives for s in senses if shared or not set(d) & set(s))
        if not table:
            raise ConfigurationError(
                f"with {n_electrodes} electrodes every sense pair shares an electrode with the "
                "drive pair; use more electrodes, or keep the shared pairs with shared=True"
            )
        return cls(table, n_electrodes)

    @classmethod
    def adjacent(cls, n_electrodes: int, shared: bool = False) -> "Protocol":
        """Adjacent protocol, neighbours drive and sense (Barber and Brown 1984): n (n - 3) rows.

        By reciprocity n (n - 3) / 2 of the measurements are independent.
        """
        return cls.skip(n_electrodes, 0, shared=shared)

    @classmethod
    def opposite(cls, n_electrodes: int, shared: bool = False) -> "Protocol":
        """Opposite protocol: facing electrodes drive, neighbours sense; n / 2 (n - 4) rows."""
        if n_electrodes % 2:
            raise ConfigurationError(
                f"electrodes face each other only in even numbers, got {n_electrodes}; use "
                f"skip={max(n_electrodes // 2 - 1, 0)} for pairs that nearly do"
            )
        return cls.skip(n_electrodes, n_electrodes // 2 - 1, sense_skip=0, shared=shared)

    @classmethod
    def from_file(cls, path: str | Path, n_electrodes: int | None = None) -> "Protocol":
        """Read a table with the header drive_plus,drive_minus,sense_plus,sense_minus, or a,b,m,n.

        Electrodes are counted from 0, or from 1 where the largest number is `n_electrodes` and none
        is 0; without `n_electrodes` the largest number in the table is the last electrode. Raises
        ConfigurationError, naming the line, for values that are no integers, a wrong number of
        columns, electrodes that do not exist, and repeated measurements; and for a table without
        electrode 0 where `n_electrodes` is not given.
        """
        try:
            text = read_text(path)
            mark = max(",;\t", key=text.partition("\n")[0].count)
            reader = csv.reader(io.StringIO(text, newline=""), delimiter=mark, strict=True)
            lines = [(reader.line_num, row) for row in reader if any(row)]
        except (ConfigurationError, csv.Error) as error:
            raise ConfigurationError(f"cannot read the protocol {path}: {error}") from error
        header = tuple(name.strip() for name in lines[0][1]) if lines else ()
        if tuple(map(str.casefold, header)) not in (HEADER, tuple("abmn")):
            raise ConfigurationError(
                f"{path}: expected the header {','.join(HEADER)}, got "
                f"{','.join(header) or 'an empty file'}"
            )
        if len(lines) == 1:
            raise ConfigurationError(f"{path}: expected measurements after the header, got none")
        used = [int(c) for _, row in lines[1:] for c in row if re.fullmatch(r"\s*\d{1,9}\s*", c)]
        least, largest = min(used, default=0), max(used, default=0)
        if least > 0 and n_electrodes is None:
            raise ConfigurationError(
                f"{path} has no electrode 0: where it counts from 1, write '{path}:{largest}'; "
                f"where electrode 0 is not used, '{path}:{largest + 1}'"
            )
        base = int(least > 0 and largest == n_electrodes)
        table: dict[Row, int] = {}
        for number, cells in lines[1:]:
            where = f"{path}, line {number}"
            row = _row(cells, MAX_ELECTRODES if n_electrodes is None else n_electrodes, where, base)
            if row in table:
                raise ConfigurationError(
                    f"{where}: measurement {_text(row)} is in line {table[row]} already; leave "
                    "one of them out"
                )
            table[row] = number
        last = max(max(row) for row in table)
        return cls(tuple(table), last + 1 if n_electrodes is None else n_electrodes)

    def to_file(self, path: str | Path) -> None:
        """Write the table as a CSV file for `from_file`, atomically."""
        with atomic_file(path) as temporary:
            rows = (HEADER, *self.table)
            temporary.write_text("".join(_text(row) + "\n" for row in rows), encoding="utf-8")

    @classmethod
    def from_name(
        cls, text: str, n_electrodes: int | None = None, folder: Path = Path()
    ) -> "Protocol":
        """Protocol of a name or a table file, as options, URIs and recipes give it.

        Args:
            text: `pairwise`, `adjacent`, `opposite`, `skip:N` or the path of a CSV file for
                `from_file`; each may be followed by the number of electrodes, "adjacent:16", and
                "+driven" for the sense pairs that share an electrode with the drive pair, too.
            n_electrodes: number of electrodes of the sensor; None where no design is known.
            folder: start of a relative path.

        Raises:
            ConfigurationError: for an unknown name, a name without number of electrodes, and a
                number in the text other than `n_electrodes`.
        """
        # The pattern fits every text.
        name, skip, file, number, plus = _TEXT.fullmatch(text).groups()  # type: ignore[union-attr]
        if plus and (file is not None or name == "pairwise"):
            raise ConfigurationError(
                f"{plus} follows adjacent, opposite or skip:N, each with :ELECTRODES, got '{text}'"
            )
        if file is not None and not os.path.isfile(folder / file):  # noqa: PTH113  false for impossible names
            raise ConfigurationError(
                f"expected a protocol: {', '.join(_NAMES)}, skip:N, each with :ELECTRODES where "
                f"no sensor design gives their number, or a CSV file that exists, got '{text}'"
            )
        if number and n_electrodes not in (None, int(number)):
            raise ConfigurationError(
                f"protocol '{text}' is for {number} electrodes, the sensor has {n_electrodes}; "
                f"leave ':{number}' out, or give the design of that sensor"
            )
        electrodes = int(number) if number else n_electrodes
        if file is not None:
            return cls.from_file(folder / file, electrodes)
        if electrodes is None:
            raise ConfigurationError(
                f"protocol '{text}' needs a number of electrodes, and no sensor design gives it; "
                f"write '{text}:16' for 16 electrodes"
            )
        if skip:
            return cls.skip(electrodes, int(skip), shared=bool(plus))
        return _NAMES[name](electrodes, *([True] if plus else []))

    @classmethod
    def from_rows(cls, rows: Iterable[Iterable[int]], n_electrodes: int) -> "Protocol":
        """Protocol from any iterable of rows of four integers."""
        try:
            table = tuple(tuple(int(e) for e in row) for row in rows)
        except (TypeError, ValueError, OverflowError) as error:
            raise ConfigurationError(f"rows: expected rows of four integers: {error}") from error
        return cls(table, n_electrodes)  # type: ignore[arg-type]

    def __len__(self) -> int:
        """Number of measurements in one frame."""
        return len(self.table)

    def __str__(self) -> str:
        """Name and size, "adjacent:16 (208 measurements)", or the beginning of another table."""
        size = f"{len(self)} measurement{'s' * (len(self) > 1)}"
        first = ", ".join(self.labels[:3])
        name = self.short_name()
        return f"{name or f'a table for {self.n_electrodes} electrodes'} ({size}" + (
            ")" if name else f", first {first})"
        )

    def short_name(self) -> str | None:
        """Text that `from_name` reads, such as "adjacent:16"; None for a table without a name."""
        skip = self.table[0][1] - self.table[0][0] - 1
        for name, plus in itertools.product((*_NAMES, f"skip:{skip}"), ("", "+driven")):
            text = f"{name}:{self.n_electrodes}{plus}"
            with contextlib.suppress(ConfigurationError):
                if Protocol.from_name(text) == self:
                    return text
        return None

    def require_same(self, other: "Protocol", owner: str, origin: str, remedy: str) -> None:
        """Refuse another protocol.

        Args:
            other: protocol to compare with this one.
            owner: beginning of the message, such as "this pipeline was trained for".
            origin: source of the other protocol, such as "the board measures".
            remedy: end of the message.

        Raises:
            FrameError: for another protocol; the message names both and where they first differ.
        """
        if other == self:
            return
        pairs = zip(self.labels, other.labels, strict=False)
        first = next((f" (from '{a}' against '{b}' on)" for a, b in pairs if a != b), "")
        raise FrameError(f"{owner} {self}, {origin} {other}{first}; {remedy}")

    @property
    def shares(self) -> tuple[bool, ...]:
        """Whether the sense pair of each measurement has one of the driven electrodes."""
        return tuple(bool({*row[:2]} & {*row[2:]}) for row in self.table)

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the measurements, '0-1' for equal drive and sense pairs, else '0-1/2-3'."""
        return _labels(self.table)

    @property
    def rank(self) -> int:
        """Number of independent measurements, by linearity and reciprocity.

        Each measurement is a linear functional of the symmetric impedance matrix; the rank is the
        dimension of their span, at most the n (n - 1) / 2 unknowns of the matrix.
        """
        return int(np.linalg.matrix_rank(self.forms))

    @property
    def forms(self) -> NDArray[np.float64]:
        """Linear form of each measurement in Z[i, j], i <= j, (measurements, n (n + 1) / 2)."""
        drive, sense = self.patterns()
        products = np.einsum("im,jm->mij", drive, sense)
        rows, columns = np.triu_indices(self.n_electrodes)
        return np.asarray((products + np.swapaxes(products, 1, 2))[:, rows, columns])

    def patterns(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Drive and sense patterns, each (n_electrodes, measurements), entries -1, 0, +1."""
        table = np.array(self.table)
        columns = np.arange(len(table))
        drive = np.zeros((self.n_electrodes, len(table)))
        sense = np.zeros_like(drive)
        drive[table[:, 0], columns], drive[table[:, 1], columns] = 1.0, -1.0
        sense[table[:, 2], columns], sense[table[:, 3], columns] = 1.0, -1.0
        return drive, sense

    def measure(self, impedance: ArrayLike) -> NDArray[np.inexact]:
        """Transfer impedances [ohm], (..., measurements), of matrices (..., n_el, n_el) [ohm].

        Raises ConfigurationError for a matrix of another number of electrodes.
        """
        Z = np.asarray(impedance)
        if Z.shape[-2:] != (self.n_electrodes, self.n_electrodes):
            raise ConfigurationError(
                f"expected an impedance matrix of shape ({self.n_electrodes}, "
                f"{self.n_electrodes}), got {Z.shape}"
            )
        a, b, c, d = np.array(self.table).T
        measured: NDArray[np.inexact] = Z[..., c, a] - Z[..., d, a] - Z[..., c, b] + Z[..., d, b]
        return measured


_NAMES: dict[str, Callable[..., Protocol]] = {
    "pairwise": Protocol.pairwise,
    "adjacent": Protocol.adjacent,
    "opposite": Protocol.opposite,
}
_TEXT = re.compile(
    r"(pairwise|adjacent|opposite|skip:(\d{1,3})|(.*?))(?::(\d{1,3}))?(\+driven)?", re.DOTALL
)


@lru_cache(maxsize=16)  # live loops ask for every frame
def _labels(table: tuple[Row, ...]) -> tuple[str, ...]:
    return tuple(f"{a}-{b}" if (a, b) == (c, d) else f"{a}-{b}/{c}-{d}" for a, b, c, d in table)


def _ring_pairs(n_electrodes: int, skip: int) -> list[tuple[int, int]]:
    """All different pairs (i, i + skip + 1) around the rim; opposite pairs would come twice."""
    if not 0 <= skip <= n_electrodes - 2:
        raise ConfigurationError(
            f"a pair among {n_electrodes} electrodes can skip 0 to {max(n_electrodes - 2, 0)} of "
            f"them, got {skip}"
        )
    step = skip + 1
    starts = range(n_electrodes // 2 if 2 * step == n_electrodes else n_electrodes)
    return [(i, (i + step) % n_electrodes) for i in starts]


def _row(cells: list[str], n_electrodes: int, where: str, base: int) -> Row:
    """Measurement from the cells of one line of a protocol file that counts from `base`."""
    if len(cells) != len(HEADER):
        raise ConfigurationError(
            f"{where}: expected {len(HEADER)} electrodes separated by commas, got {len(cells)}"
        )
    if not all(re.fullmatch(r"[+-]?\d{1,9}", cell.strip()) for cell in cells):
        raise ConfigurationError(
            f"{where}: electrodes are whole numbers, got {shorten_text(','.join(cells))}"
        )
    a, b, c, d = (int(cell) - base for cell in cells)
    _check((a, b, c, d), n_electrodes, where)
    return a, b, c, d


def _check(row: Row, n_electrodes: int, where: str) -> None:
    """Refuse electrodes that do not exist, and pairs of one electrode."""
    if len(row) != len(HEADER) or any(not 0 <= e < n_electrodes for e in row):
        raise ConfigurationError(
            f"{where}: expected (drive+, drive-, sense+, sense-), each from 0 to "
            f"{n_electrodes - 1}, got {row}"
        )
    if row[0] == row[1] or row[2] == row[3]:
        raise ConfigurationError(
            f"{where}: drive and sense pairs need two different electrodes, got {row}"
        )


def _text(row: Iterable[object]) -> str:
    return ",".join(str(value) for value in row)
