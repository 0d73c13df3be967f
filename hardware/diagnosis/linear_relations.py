"""Relations between the readings of an ideal meter, from the table of its protocol alone.

The readings of an ideal meter are d . Z s with drive and sense patterns d and s and a symmetric
impedance matrix Z. Whatever the sensor, therefore: exchanging the electrodes of a pair changes the
sign (swap), exchanging drive and sense pair changes nothing (reciprocity, Geselowitz 1971), and the
voltages around a closed loop of sense pairs sum to zero, as do the readings of a closed loop of
drive pairs (Kirchhoff's voltage law and superposition).
"""

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise

from eitskin.protocol import Protocol

Pair = tuple[int, int]
Signed = tuple[int, int]
"""Number of a measurement, and its sign, +1 or -1."""


class RelationKind(StrEnum):
    """Kinds of relations."""

    DRIVE_SWAP = "swapped drives"
    SENSE_SWAP = "swapped senses"
    RECIPROCITY = "reciprocity"
    LOOP = "loop sum"


@dataclass(frozen=True, slots=True)
class Relation:
    """Signed sum of readings that is zero.

    Attributes:
        kind: law behind the relation.
        channels: numbers of the measurements, two or, in a loop, at least three.
        signs: +1 or -1 of each.
    """

    kind: RelationKind
    channels: tuple[int, ...]
    signs: tuple[int, ...]


def linear_relations(protocol: Protocol) -> tuple[Relation, ...]:
    """Independent relations of each kind between the readings of a protocol; often none."""
    return (*_swaps(protocol), *_reciprocities(protocol), *_loops(protocol))


def _swaps(protocol: Protocol) -> Iterator[Relation]:
    """Relations of measurements with the same pairs, in another order of their electrodes."""
    for same in _by_pairs(protocol).values():
        (first, sign), *others = same
        for other, turned in others:
            same_drive = protocol.table[first][:2] == protocol.table[other][:2]
            kind = RelationKind.SENSE_SWAP if same_drive else RelationKind.DRIVE_SWAP
            yield Relation(kind, (first, other), (1, -sign * turned))


def _reciprocities(protocol: Protocol) -> Iterator[Relation]:
    """Relations of measurements whose drive pair is the other's sense pair."""
    found = _by_pairs(protocol)
    for (drive, sense), same in found.items():
        if drive < sense and (sense, drive) in found:
            (forth, sign), (back, turned) = same[0], found[sense, drive][0]
            yield Relation(RelationKind.RECIPROCITY, (forth, back), (1, -sign * turned))


def _loops(protocol: Protocol) -> Iterator[Relation]:
    """Relations of closed loops of sense pairs at one drive, and of drive pairs at one sense."""
    at_drive: dict[Pair, dict[Pair, Signed]] = {}
    at_sense: dict[Pair, dict[Pair, Signed]] = {}
    for (drive, sense), same in _by_pairs(protocol).items():
        at_drive.setdefault(drive, {})[sense] = same[0]
        at_sense.setdefault(sense, {})[drive] = same[0]
    for edges in (*at_drive.values(), *at_sense.values()):
        for loop in _fundamental_loops(edges):
            channels = tuple(edges[pair][0] for pair, _ in loop)
            signs = tuple(edges[pair][1] * direction for pair, direction in loop)
            yield Relation(RelationKind.LOOP, channels, signs)


def _by_pairs(protocol: Protocol) -> Mapping[tuple[Pair, Pair], list[Signed]]:
    """Measurements by drive and sense pair, each pair from its smaller electrode, with signs."""
    found: dict[tuple[Pair, Pair], list[Signed]] = {}
    for number, (a, b, c, d) in enumerate(protocol.table):
        key = ((min(a, b), max(a, b)), (min(c, d), max(c, d)))
        found.setdefault(key, []).append((number, 1 if (a < b) == (c < d) else -1))
    return found


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
    tree = {_ordered(path[-2], path[-1])[0] for path in paths.values() if len(path) > 1}
    for a, b in edges:
        if (a, b) in tree:
            continue
        from_a, from_b = paths[a], paths[b]
        shared = sum(x == y for x, y in zip(from_a, from_b, strict=False))
        nodes = [*from_a[shared - 1 :][::-1], *from_b[shared:]]  # from a over the common node to b
        yield [_ordered(x, y) for x, y in pairwise([*nodes, a])]


def _ordered(a: int, b: int) -> tuple[Pair, int]:
    """Pair of two electrodes from the smaller one, and the direction from a to b."""
    return ((a, b), 1) if a < b else ((b, a), -1)
