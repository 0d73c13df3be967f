"""Check of readings without any model of the sensor: dead channels, and laws of linear circuits.

The readings of an ideal meter are d . Z s with drive and sense patterns d and s and a symmetric
impedance matrix Z. Whatever the sensor, therefore: exchanging the electrodes of a pair changes the
sign (swap), exchanging drive and sense pair changes nothing (reciprocity, Geselowitz 1971), and the
voltages around a closed loop of sense pairs sum to zero, as do the readings of a closed loop of
drive pairs (Kirchhoff's voltage law and superposition).
"""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.errors import DataError, FrameError
from eitskin.frame import Frame
from eitskin.hardware.diagnosis.checked_frames import (
    MIN_FLAGGED,
    Bools,
    CheckedFrames,
    Finding,
    FindingKind,
    channel_names,
    find_frozen,
    finding,
    findings_by_electrode,
    readings,
)
from eitskin.hardware.diagnosis.sensor_check import board_flags
from eitskin.protocol import Protocol

Pair = tuple[int, int]
Signed = tuple[int, int]
"""Number of a measurement, and its sign, +1 or -1."""


@dataclass(frozen=True, slots=True)
class Relation:
    """Signed sum of readings that is zero.

    Attributes:
        kind: law behind the relation.
        channels: numbers of the measurements, two or, in a loop, at least three.
        signs: +1 or -1 of each.
    """

    kind: FindingKind
    channels: tuple[int, ...]
    signs: tuple[int, ...]


def linear_relations(protocol: Protocol) -> tuple[Relation, ...]:
    """Independent relations of each kind between the readings of a protocol; often none."""
    return (*_swaps(protocol), *_reciprocities(protocol), *_loops(protocol))


def _swaps(protocol: Protocol) -> Iterator[Relation]:
    """Relations of measurements with the same pairs, in another order of their electrodes."""
    for same in _measurements_by_pairs(protocol).values():
        (first, sign), *others = same
        for other, turned in others:
            same_drive = protocol.table[first][:2] == protocol.table[other][:2]
            kind = FindingKind.SENSE_SWAP if same_drive else FindingKind.DRIVE_SWAP
            yield Relation(kind, (first, other), (1, -sign * turned))


def _reciprocities(protocol: Protocol) -> Iterator[Relation]:
    """Relations of measurements whose drive pair is the other's sense pair."""
    by_pairs = _measurements_by_pairs(protocol)
    for (drive, sense), same in by_pairs.items():
        if drive < sense and (sense, drive) in by_pairs:
            (forth, sign), (back, turned) = same[0], by_pairs[sense, drive][0]
            yield Relation(FindingKind.RECIPROCITY, (forth, back), (1, -sign * turned))


def _loops(protocol: Protocol) -> Iterator[Relation]:
    """Relations of closed loops of sense pairs at one drive, and of drive pairs at one sense."""
    at_drive: dict[Pair, dict[Pair, Signed]] = {}
    at_sense: dict[Pair, dict[Pair, Signed]] = {}
    for (drive, sense), same in _measurements_by_pairs(protocol).items():
        at_drive.setdefault(drive, {})[sense] = same[0]
        at_sense.setdefault(sense, {})[drive] = same[0]
    for edges in (*at_drive.values(), *at_sense.values()):
        for loop in _fundamental_loops(edges):
            channels = tuple(edges[pair][0] for pair, _ in loop)
            signs = tuple(edges[pair][1] * direction for pair, direction in loop)
            yield Relation(FindingKind.LOOP, channels, signs)


def _measurements_by_pairs(protocol: Protocol) -> Mapping[tuple[Pair, Pair], list[Signed]]:
    """Measurements by drive and sense pair, each pair from its smaller electrode, with signs."""
    by_pairs: dict[tuple[Pair, Pair], list[Signed]] = {}
    for number, (a, b, c, d) in enumerate(protocol.table):
        key = ((min(a, b), max(a, b)), (min(c, d), max(c, d)))
        by_pairs.setdefault(key, []).append((number, 1 if (a < b) == (c < d) else -1))
    return by_pairs


def _fundamental_loops(edges: Mapping[Pair, Signed]) -> Iterator[list[tuple[Pair, int]]]:
    """Fundamental loops of the graph of pairs: its edges with their directions along the loop.

    A spanning tree, breadth first, leaves out one edge for each loop (Kirchhoff 1847).
    """
    neighbours: dict[int, list[int]] = {}
    for a, b in edges:
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    paths: dict[int, list[int]] = {}
    for root in neighbours:
        if root in paths:
            continue
        paths[root] = [root]
        waiting = deque([root])
        while waiting:
            here = waiting.popleft()
            for there in neighbours[here]:
                if there not in paths:
                    paths[there] = [*paths[here], there]
                    waiting.append(there)
    tree = {_order_pair(path[-2], path[-1])[0] for path in paths.values() if len(path) > 1}
    for a, b in edges:
        if (a, b) in tree:
            continue
        from_a, from_b = paths[a], paths[b]
        shared = sum(x == y for x, y in zip(from_a, from_b, strict=False))
        nodes = [*from_a[shared - 1 :][::-1], *from_b[shared:]]  # from a over the common node to b
        yield [_order_pair(x, y) for x, y in pairwise([*nodes, a])]


def _order_pair(a: int, b: int) -> tuple[Pair, int]:
    """Pair of two electrodes from the smaller one, and the direction from a to b."""
    return ((a, b), 1) if a < b else ((b, a), -1)


Complex = NDArray[np.complex128]

UNEQUAL = 0.03
"""Relative difference of two readings that an ideal meter gives alike; boards have 0.4 %."""
UNEQUAL_SMALL = 0.002
"""The same, as a share of the median reading, below which a difference counts for nothing."""
SIGNIFICANT = 6.0
"""Difference over its standard error beyond which it is no noise."""
MAX_LIMIT_SHARE = 0.5
"""Share of violated relations from which the board, and not a channel, is at fault."""
DEAD = 1e-6
"""Reading over the median channel's below which a channel is dead."""
MIN_VALUES = 8
"""Least number of different values of a channel, next to its limit, that is not stuck there."""

LAWS = {
    FindingKind.DRIVE_SWAP: (
        "exchanging the two drive electrodes",
        "source and sink load the sensor differently",
    ),
    FindingKind.SENSE_SWAP: (
        "exchanging the two sense electrodes",
        "the two sense inputs load the sensor differently, or there is an offset",
    ),
    FindingKind.RECIPROCITY: (
        "exchanging drive and sense pair",
        "source and sense inputs load the sensor differently",
    ),
    FindingKind.LOOP: (
        "going around a closed loop of pairs",
        "gains or offsets differ from channel to channel, or the inputs load the sensor",
    ),
}
"""Laws of an ideal meter by the kind of their findings: what is exchanged, and the likely cause."""


@dataclass(frozen=True, slots=True)
class LawCheck:
    """Outcome of one law for all relations that the protocol allows.

    Attributes:
        kind: law.
        relations: number of relations.
        violated: number of those that readings violate beyond tolerance and noise.
        median: median difference, relative to the largest reading of each relation.
        largest: largest of these differences.
    """

    kind: FindingKind
    relations: int
    violated: int
    median: float
    largest: float


@dataclass(frozen=True, slots=True)
class ReadingCheck:
    """Findings of a check of readings, and the laws that were checked.

    Attributes:
        findings: faults, in words.
        laws: outcome of every law that the protocol allows to check; empty where it allows none.
        magnitudes: whether the readings are magnitudes, whose laws are weaker: pairs have equal
            magnitudes, and the largest of a loop is at most the sum of the others.

    Example:
        >>> import numpy as np
        >>> from eitskin import Protocol
        >>> from eitskin.hardware import check_readings
        >>> rng = np.random.default_rng(0)
        >>> check_readings(600.0 + rng.normal(0.0, 0.1, (16, 28)), Protocol.pairwise(8)).findings
        ()
    """

    findings: tuple[Finding, ...]
    laws: tuple[LawCheck, ...]
    magnitudes: bool

    @property
    def healthy(self) -> bool:
        """Whether there are no findings."""
        return not self.findings


def check_readings(
    impedance: ArrayLike, protocol: Protocol, status: NDArray[np.uint8] | None = None
) -> ReadingCheck:
    """Findings that need no model of the sensor, which may be bent, touched and of any shape.

    Args:
        impedance: readings, (frames, measurements), of any unit and of one sensor.
        protocol: drive and sense electrodes of the measurements.
        status: `Status` bits, (frames, measurements); none set when omitted.

    Raises:
        DataError: for readings of another shape.

    Example:
        >>> import numpy as np
        >>> from eitskin import Protocol
        >>> from eitskin.hardware import check_readings
        >>> stuck = np.full((16, 28), 600.0) + np.random.default_rng(0).normal(0.0, 0.1, (16, 28))
        >>> stuck[:, 4] = 600.0
        >>> [finding.what for finding in check_readings(stuck, Protocol.pairwise(8)).findings]
        [<FindingKind.STUCK: 'stuck'>]
    """
    values = np.array(impedance, np.complex128)
    if values.ndim != 2 or values.shape[1] != len(protocol) or not len(values):
        raise DataError(
            f"expected readings of {len(protocol)} channels, one row for each frame, got shape "
            f"{values.shape}; name the protocol of the recording"
        )
    values = readings(values)
    bits = np.zeros(values.shape, np.uint8) if status is None else np.asarray(status, np.uint8)
    checked = CheckedFrames(protocol, values, bits, np.ones(len(protocol)))
    typical = np.maximum(np.abs(checked.value), np.finfo(float).tiny)
    checked = CheckedFrames(protocol, values, bits, typical)
    dead = _dead(checked)
    limited = _channels_at_limit(checked) & ~dead
    good = checked.usable & ~dead & ~limited
    wrong = (
        (
            FindingKind.DEAD,
            dead,
            "its value is always zero: check its multiplexer path and its wires",
        ),
        (
            FindingKind.CLIPPED,
            limited,
            "it repeats the board's largest value: lower the current or the gain",
        ),
    )
    findings = list(board_flags(checked))
    for what, channels, remedy in wrong:
        findings += findings_by_electrode(what, channels, checked, f"is {what}", remedy)
    findings += [each for each in find_frozen(checked) if not dead[list(each.channels)].all()]
    finite = values[np.isfinite(values)]
    magnitudes = bool(not finite.imag.any() and (finite.real >= 0.0).all())
    relations = [each for each in linear_relations(protocol) if good[list(each.channels)].all()]
    laws = []
    for kind in LAWS:
        chosen = [relation for relation in relations if relation.kind == kind]
        if chosen:
            law, law_findings = _check_law(kind, chosen, checked, magnitudes=magnitudes)
            laws.append(law)
            findings += law_findings
    return ReadingCheck(tuple(findings), tuple(laws), magnitudes)


def check_frames(frames: Sequence[Frame]) -> ReadingCheck:
    """Check of the readings of frames of one protocol, as by `check_readings`.

    Raises FrameError for no frames, or frames of several protocols.
    """
    if len({frame.protocol for frame in frames}) != 1:
        raise FrameError(
            f"a check needs frames of one protocol, got {len(frames)} frames; check one board at a "
            "time"
        )
    impedance = np.array([frame.impedance for frame in frames])
    return check_readings(impedance, frames[0].protocol, np.array([f.status for f in frames]))


def _dead(checked: CheckedFrames) -> Bools:
    """Channels that never read anything but zero, (measurements,)."""
    filled = np.where(checked.finite, np.abs(checked.impedance), 0.0)
    largest = filled.max(axis=0)
    return np.asarray((largest <= DEAD * np.median(largest)) & checked.finite.any(axis=0))


def _channels_at_limit(checked: CheckedFrames) -> Bools:
    """Channels that stay at the board's largest value, unlike a measurement, (measurements,).

    The largest value of the recording is a limit where a channel repeats it exactly, in more than
    a few frames, and takes many other values as well, or where several channels do.
    """
    parts = np.stack([checked.impedance.real, checked.impedance.imag])
    sizes = np.where(np.isfinite(parts), np.abs(parts), 0.0).max(axis=0)
    limit = sizes.max()
    if not limit or len(sizes) < MIN_VALUES:
        return np.zeros(sizes.shape[1], bool)
    there = (sizes == limit).mean(axis=0) > MIN_FLAGGED
    varied = np.array([len(np.unique(column)) > MIN_VALUES for column in sizes.T])
    return np.asarray(there if there.sum() > 1 else there & varied)


def _check_law(
    kind: FindingKind, relations: list[Relation], checked: CheckedFrames, *, magnitudes: bool
) -> tuple[LawCheck, list[Finding]]:
    """Outcome of one law, and its findings."""
    median = float(np.median(np.abs(checked.value)))
    differences, wrong, ratios, signs = [], [], [], 0
    for relation in relations:
        readings = checked.impedance[:, list(relation.channels)]
        difference, noise = _difference(readings, relation, magnitudes=magnitudes)
        sizes = np.abs(np.nanmean(readings, axis=0))
        largest = float(sizes.max()) or 1.0
        differences.append(difference / largest)
        too_large = difference > UNEQUAL * largest + UNEQUAL_SMALL * median
        wrong.append(bool(too_large and difference > SIGNIFICANT * noise))
        if wrong[-1]:
            ratios.append(largest / max(float(sizes.min()), UNEQUAL_SMALL * median))
            signs += len(sizes) == 2 and float(np.ptp(sizes)) < UNEQUAL * largest
    law = LawCheck(
        kind, len(relations), sum(wrong), float(np.median(differences)), max(differences)
    )
    if not any(wrong):
        return law, []
    channels = _suspects(relations, np.array(wrong), len(checked.expected))
    text = _law_text(law, float(np.median(ratios)), signs, channels, checked)
    return law, [finding(kind, channels, text)]


def _suspects(relations: Sequence[Relation], wrong: Bools, count: int) -> Bools:
    """Channels that keep no relation, or without any all of the violated ones, (count,)."""
    takes_part = np.zeros((len(relations), count), bool)
    for row, relation in zip(takes_part, relations, strict=True):
        row[list(relation.channels)] = True
    violated = takes_part[wrong].any(axis=0)
    only = violated & ~takes_part[~wrong].any(axis=0)
    return np.asarray(only if only.any() else violated)


def _difference(readings: Complex, relation: Relation, *, magnitudes: bool) -> tuple[float, float]:
    """Violation of a relation by the mean frame, and its standard error.

    Args:
        readings: readings of the relation's channels, (frames, channels).
        relation: signed sum that is to be zero.
        magnitudes: whether only magnitudes are known.
    """
    if magnitudes:
        sizes = np.abs(readings)
        largest = int(np.nanmean(sizes, axis=0).argmax())
        sums: Complex = 2.0 * sizes[:, largest] - sizes.sum(axis=1) + 0j
        mean = max(float(np.nanmean(sums.real)), 0.0)
    else:
        sums = readings @ np.array(relation.signs)
        mean = float(np.abs(np.nanmean(sums)))
    count = int(np.isfinite(sums).sum())
    spread = float(np.nanstd(sums)) if count > 1 else 0.0
    return mean, spread / np.sqrt(max(count, 1))


def _law_text(
    law: LawCheck, ratio: float, signs: int, channels: Bools, checked: CheckedFrames
) -> str:
    """Violation in words, with its likely cause and the remedy."""
    exchange, cause = LAWS[law.kind]
    names = channel_names(channels, checked)
    if signs == law.violated and law.kind != FindingKind.LOOP:
        return (
            f"{exchange} gives the wrong sign in {law.violated} of {law.relations} cases "
            f"({names}): the table of the protocol has two electrodes of a pair exchanged there, "
            "or the board leaves signs out"
        )
    if law.kind == FindingKind.LOOP:
        seen = (
            f"voltages do not add up {exchange} in {law.violated} of {law.relations} cases, by up "
            f"to {100.0 * law.largest:.0f} % of their largest"
        )
    else:
        seen = (
            f"{exchange} changes {law.violated} of {law.relations} readings, by a factor of "
            f"{ratio:.2g} in the median, where an ideal meter reads the same"
        )
    if law.violated <= MAX_LIMIT_SHARE * law.relations:
        return f"{seen}: check the paths of {names}"
    return (
        f"{seen}: {cause}, or the order of the channels is not that of the protocol; compare the "
        "table, or fit the board with 'eitskin fit instrument'"
    )
