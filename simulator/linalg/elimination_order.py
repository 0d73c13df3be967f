"""Orders in which the unknowns of a mesh are eliminated: by strips, or by nested dissection.

Blocks of a long, thin body are strips across it, which are small. For others, elements are halved
across their longest extent, and each half likewise (nested dissection, George 1973); unknowns that
two halves share are eliminated after those within the halves. For n unknowns in the plane the
factors then have of the order of n log n entries.
"""

import warnings
from dataclasses import dataclass
from itertools import count
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array

from eitskin.errors import ConfigurationError

Indices = NDArray[np.int64]
OrderName = Literal["block Cholesky", "nested dissection"]

# Sum of the cubed strip sizes per matrix entry at which both orders take equally long: strips were
# faster below 1.3e3 and dissection above 2e3, on rectangles and discs of 3,000 to 27,000 unknowns.
_STRIP_WORK = 1.5e3
# of the extent, by which positions of elements next to each other differ
_POSITION_TOLERANCE = 1e-6
_LEAF = 240  # unknowns, about, whose elements are not dissected further


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Unknowns eliminated together, after the blocks that they separate.

    Attributes:
        own: the unknowns.
        within: numbers, in the order of elimination, of the blocks that these unknowns separate.
    """

    own: Indices
    within: tuple[int, ...]


def choose_order(
    name: str | None,
    positions: tuple[Indices, Indices],
    numbers: Indices,
    middles: NDArray[np.float64],
) -> tuple[OrderName, list[Block]]:
    """The order called `name`, or the faster one for the shape of the body.

    Raises ConfigurationError for another name.

    Args:
        name: "block Cholesky", by strips; "nested dissection"; or None. "sparse LU", of earlier
            versions, is nested dissection.
        positions: rows and columns of the matrix entries.
        numbers: unknowns of each element, (elements, functions).
        middles: middles of the elements, (elements, axes) [m]; strips begin where the first is
            lowest.
    """
    if name == "sparse LU":
        warnings.warn(
            'solver="sparse LU" is deprecated; use "nested dissection", which is faster',
            DeprecationWarning,
            stacklevel=3,
        )
        name = "nested dissection"
    if name is not None and name not in get_args(OrderName):
        raise ConfigurationError(
            f"solver must be one of {get_args(OrderName)} or None, got {name!r}"
        )
    if name != "nested dissection":
        x = middles[:, 0]
        level = level_structure(
            numbers, np.flatnonzero(x <= x.min() + _POSITION_TOLERANCE * np.ptp(x))
        )
        work = float((np.bincount(level).astype(float) ** 3).sum())
        if name is not None or work <= _STRIP_WORK * len(positions[0]):
            return "block Cholesky", strips(*positions, level)
    return "nested dissection", dissection(numbers, middles)


def level_structure(numbers: Indices, first: Indices) -> Indices:
    """Strip of each unknown, (unknowns,): level of a breadth-first search from elements `first`.

    Args:
        numbers: unknowns of each element, (elements, functions).
        first: elements of level 0.

    An element then has unknowns of two consecutive strips at most, on any mesh (level structure,
    George and Liu 1981). Raises ConfigurationError for a mesh that is not connected.
    """
    elements, functions = numbers.shape
    unknowns = int(numbers.max()) + 1
    incidence = (np.repeat(np.arange(elements), functions), numbers.ravel())
    shares = coo_array((np.ones(numbers.size, dtype=np.int8), incidence), (elements, unknowns))
    by_element, by_unknown = shares.tocsr(), shares.T.tocsr()
    level = np.full(unknowns, -1)
    reached = np.zeros(elements, dtype=bool)
    front, number = first, 0
    while len(front):
        reached[front] = True
        new = np.unique(by_element[front].indices)
        new = new[level[new] < 0]
        level[new] = number
        adjacent = np.unique(by_unknown[new].indices)
        front = adjacent[~reached[adjacent]]
        number += 1
    if level.min() < 0:
        raise ConfigurationError(
            "expected a sensor of one connected body, got parts that do not touch; join them in "
            "the design"
        )
    return level


def strips(rows: Indices, columns: Indices, strip: Indices) -> list[Block]:
    """Blocks of strips, which matrix entries at (rows, columns) couple to the next one at most.

    The unknowns of a strip that are coupled to the next one come last in its block.
    """
    crossing = strip[rows] != strip[columns]
    if np.any(np.abs(strip[rows] - strip[columns]) > 1):
        raise ValueError("a matrix entry couples strips that are not consecutive")
    lower_end = np.where(strip[rows] < strip[columns], rows, columns)[crossing]
    coupled = np.zeros(len(strip), dtype=bool)
    coupled[lower_end] = True
    order = np.lexsort((coupled, strip))
    parts = np.split(order, np.flatnonzero(np.diff(strip[order])) + 1)
    return [Block(own, (number - 1,) if number else ()) for number, own in enumerate(parts)]


def dissection(numbers: Indices, middles: NDArray[np.float64]) -> list[Block]:
    """Blocks of unknowns by nested dissection of the elements.

    Args:
        numbers: unknowns of each element, (elements, functions); -1 for none.
        middles: middles of the elements, (elements, axes) [m].
    """
    numbers = numbers + 1
    elements_of = np.bincount(numbers.ravel())
    leaf = max(1, _LEAF * len(numbers) // len(elements_of))
    blocks: list[Block] = []
    turn, leaves = np.full(len(elements_of), len(numbers)), count()

    def dissect(elements: Indices) -> tuple[tuple[int, ...], Indices, Indices]:
        """Last blocks, border, and number of elements of each border unknown."""
        if len(elements) <= leaf:
            last: tuple[int, ...] = ()
            unknowns, shares = np.unique(numbers[elements], return_counts=True)
            turn[unknowns] = np.minimum(turn[unknowns], next(leaves))
        else:
            axis = int(np.ptp(middles[elements], axis=0).argmax())
            rising = elements[np.argsort(middles[elements, axis], kind="stable")]
            cut = _middle(middles[rising, axis])
            halves = [dissect(half) for half in (rising[:cut], rising[cut:])]
            last = halves[0][0] + halves[1][0]
            borders = np.concatenate([border for _, border, _ in halves])
            unknowns, numbered = np.unique(borders, return_inverse=True)
            shares = np.zeros(len(unknowns), dtype=np.int64)
            np.add.at(shares, numbered, np.concatenate([shares for *_, shares in halves]))
        whole = shares == elements_of[unknowns]  # no element elsewhere has these unknowns
        own = unknowns[whole & (unknowns > 0)] - 1
        if len(own):
            # Neighbours follow each other, and stay together in the borders of blocks within.
            blocks.append(Block(own[np.argsort(turn[own + 1], kind="stable")], last))
            last = (len(blocks) - 1,)
        return last, unknowns[~whole], shares[~whole]

    dissect(np.arange(len(numbers)))
    return blocks


def _middle(rising: NDArray[np.float64]) -> int:
    """Number at which rising positions are halved: between two that differ, where any do."""
    steps = np.flatnonzero(np.diff(rising) > _POSITION_TOLERANCE * (rising[-1] - rising[0])) + 1
    half = len(rising) // 2
    return int(steps[np.abs(steps - half).argmin()]) if len(steps) else half
