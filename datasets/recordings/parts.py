"""Columns of complex values in two parts, and electrodes, by the names of columns."""

import itertools
import re
from collections.abc import Sequence
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError, DataError
from eitskin.protocol import MAX_ELECTRODES, Protocol

PhaseUnit = Literal["", "deg", "rad"]

_PHASE: Final = "phase|phas|phi|theta|angle|arg|ph"
_WORDS: Final = (
    ("magnitude", "[zv]?(?:magnitude|magn|mag|amplitude|ampl|amp|abs|modulus|mod|rms|betrag)"),
    ("phase", _PHASE),
    ("real", "[zv]?(?:real|re|resistance)|z'(?!')"),
    ("imaginary", "[zv]?(?:imaginary|imag|im|reactance)|z(?:''|\")"),
    ("real", "r"),
    ("imaginary", "i"),
    ("real", "i"),
    ("imaginary", "q"),
    ("real", "r"),
    ("imaginary", "x"),
    ("magnitude", "z"),
    ("phase", _PHASE),
)
_PARTS: Final = tuple(
    (part, re.compile(rf"(?:(?<![A-Za-z])|(?<=[a-z])(?=[A-Z]))(?i:{words})(?![a-z])"))
    for part, words in _WORDS
)
_UNIT: Final = re.compile(
    r"\s*[\[(][^\[(\d]*[\])]$|[\s_.-]*(?:deg|rad|degrees|radians|°|[kmµu]?(?:ohms?|Ω|Ω)|[mµu]?V)$",
    re.I,
)
_PREFIXED_UNIT: Final = re.compile(r".*[\s_.(\[-]([kmuµM]?)(?:[oO]hms?|Ω|Ω|V)[)\]]?")
_FACTORS: Final = {"": 1.0, "k": 1e3, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "M": 1e6}
_READING: Final = re.compile(
    r"impedance|resistance|reading|value|voltage|magn|ohm|^(?:[zrvu]|data|meas\w*)$", re.I
)
_ELECTRODES: Final = (
    r"a|c1|(?:drive|inj|src|i)[_ ]?(?:\+|pos|1|a)",
    r"b|c2|(?:drive|inj|src|i)[_ ]?(?:-|neg|2|b)",
    r"m|p1|(?:sense|meas|v)[_ ]?(?:\+|pos|1|m)",
    r"n|p2|(?:sense|meas|v)[_ ]?(?:-|neg|2|n)",
)
"""Names of the columns with drive+, drive-, sense+ and sense- of a reading in each row."""
_RADIANS, _DEGREES = (re.compile(rf"(?<![a-z])({w})", re.I) for w in ("rad", "deg|°"))


def pair_columns(header: Sequence[str], least: int = 2) -> dict[str, list[int]]:
    """Numbers of the columns of two parts, in one order; none without `least` pairs.

    Names of a pair are equal but for the word of the part, signs, and units behind them.
    """
    for (part, word), (other, other_word) in zip(_PARTS[::2], _PARTS[1::2], strict=True):
        first, second = _stems(header, word), _stems(header, other_word)
        shared = [stem for stem in first if stem in second]
        if len(shared) >= least:
            return {part: [first[s] for s in shared], other: [second[s] for s in shared]}
    return {}


def _stems(header: Sequence[str], word: re.Pattern[str]) -> dict[str, int]:
    """Number of each column by its name without the word."""
    names = (word.subn("*", _UNIT.sub("", name)) for name in header)
    signs = re.compile(r"[^\w*]|_")
    stems = ((signs.sub("", stem.casefold()).replace("*z", "*"), n) for stem, n in names)
    return {stem: column for column, (stem, n) in enumerate(stems) if n == 1}


def is_reading(name: str) -> bool:
    """Whether a name is one of a measured quantity."""
    return bool(_READING.search(name))


def is_phase(name: str) -> bool | None:
    """Whether a name is that of a phase, or else of an imaginary part; None for neither."""
    matching_parts = {part for part, word in _PARTS[:4] if word.search(name)}
    return "phase" in matching_parts if matching_parts & {"phase", "imaginary"} else None


def phase_unit(unit_option: str, names: Sequence[str], phases: NDArray[Any]) -> str:
    """Unit of phases as it is given, as names have it, or as it must be; raises DataError."""
    if unit_option:
        return unit_option
    for unit, pattern in (("rad", _RADIANS), ("deg", _DEGREES)):
        if any(map(pattern.search, names)):
            return unit
    largest = np.nanmax(np.abs(phases), initial=0.0)
    if 0 < largest <= 2 * np.pi:
        raise DataError(
            f"phases up to {largest:g} could be degrees or radians; say --phase-unit deg or rad"
        )
    return "deg"


def complex_values(first: NDArray[Any], second: NDArray[Any], unit: str) -> NDArray[Any]:
    """Complex values of magnitudes and phases in a unit, or of real and imaginary parts."""
    if first.shape != second.shape:
        raise DataError(
            f"expected two parts of one shape, got {first.shape} and {second.shape}; name both "
            "with --values FIRST,SECOND"
        )
    if not unit:
        return np.asarray(first + 1j * second)
    angle = np.radians(second) if unit == "deg" else second
    return np.asarray(first * np.exp(1j * angle))


def unit_factor(names: Sequence[str]) -> float:
    """Factor that makes ohm or volt of values whose names all end in one unit, as Z0_kohm; or 1."""
    prefixes = {unit[1] if unit else "" for unit in map(_PREFIXED_UNIT.fullmatch, names)}
    return _FACTORS[prefixes.pop()] if len(prefixes) == 1 else 1.0


def electrodes_of_name(name: str) -> tuple[int, ...]:
    """Numbers in the name of a column, without its unit."""
    return tuple(map(int, re.findall(r"\d{1,3}", _UNIT.sub("", name))))


def protocol_of_names(names: Sequence[str]) -> Protocol | None:
    """Protocol of names with electrodes; None for other names.

    Either four electrodes each, as E1_E9_E2_E10, or all pairs of electrodes, as Z1-2. Electrodes
    count from 1 where no name has a 0.
    """
    rows = [electrodes_of_name(name) for name in names]
    widths = {len(row) for row in rows}
    if widths not in ({4}, {2}) or len(set(rows)) < len(rows):
        return None
    base = int(counts_from_one(names))
    count = max(map(max, rows)) + 1 - base
    if widths == {2} and {frozenset(row) for row in rows} != {
        frozenset(pair) for pair in itertools.combinations(range(base, base + count), 2)
    }:
        return None  # other numbers, such as those of a sensor and its channel
    try:
        shifted = ([electrode - base for electrode in row * (4 // len(row))] for row in rows)
        return Protocol.from_rows(shifted, count) if count <= MAX_ELECTRODES else None
    except ConfigurationError:
        return None


def counts_from_one(names: Sequence[str]) -> bool:
    """Whether no name of four electrodes has a 0."""
    return min(map(min, map(electrodes_of_name, names))) > 0


def electrode_columns(names: Sequence[str]) -> tuple[str, ...]:
    """Columns with the four electrodes of the reading in each row; none in other files."""
    found = [[n for n in names if re.fullmatch(kind, n, re.I)] for kind in _ELECTRODES]
    return tuple(each[0] for each in found) if all(len(each) == 1 for each in found) else ()


def protocol_of_rows(rows: NDArray[Any]) -> Protocol:
    """Protocol of the electrodes (readings, 4) of whole frames, one after the other.

    Electrodes count from 1 where no row has a 0. Raises DataError for frames that differ.
    """
    if not np.isfinite(rows).all() or rows.min() < 0 or rows.max() > MAX_ELECTRODES:
        raise DataError(f"expected numbers of electrodes up to {MAX_ELECTRODES} in each row")
    electrodes = rows.astype(int)
    electrodes -= int(electrodes.min() > 0)
    again = (electrodes[1:] == electrodes[0]).all(axis=1)
    size = int(again.argmax()) + 1 if again.any() else len(electrodes)
    for row, place in zip(electrodes, itertools.cycle(electrodes[:size]), strict=False):
        if (row != place).any():
            raise DataError(
                f"expected the {size} readings of the first frame in all frames in one order, got "
                f"electrodes {row.tolist()} where the first has {place.tolist()} (from 0)"
            )
    try:
        return Protocol.from_rows(electrodes[:size].tolist(), int(electrodes.max()) + 1)
    except ConfigurationError as error:
        raise DataError(f"the electrodes of the rows are no protocol: {error}") from error


def require_protocol_of_names(protocol: Protocol, named: Protocol) -> None:
    """Raise DataError where names of columns say other electrodes than the protocol."""
    pairs = zip(protocol.table, named.table, strict=False)
    for number, (row, other) in enumerate(pairs):
        if {frozenset(row[:2]), frozenset(row[2:])} != {frozenset(other[:2]), frozenset(other[2:])}:
            raise DataError(
                f"measurement {number} of the protocol is {protocol.labels[number]}, but by its "
                f"name the column is {named.labels[number]} (from 0); leave --protocol out, and "
                "the names are read"
            )
