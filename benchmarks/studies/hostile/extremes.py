"""Extreme numbers in the arguments of the public functions: finite results, or typed errors.

A case is a call with good arguments. Each number in them, down to the fields of dataclasses and the
items of tuples and arrays, is replaced by each extreme value in turn.
"""

import dataclasses
import functools
import random
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from eitskin.benchmarks.studies.hostile.extreme_cases import cases
from eitskin.benchmarks.studies.hostile.texts import Draws

REALS: Final = (
    *(float("nan"), float("inf"), -float("inf"), -1.0, 0.0, -0.0, 5e-324, 1e-310, 1e-100, 1e-30),
    *(1e-12, 1e-6, 1e6, 1e12, 1e30, 1e100, 1e300, -1e300, 1.7e308),
)
WHOLES: Final = (-(2**63), -1, 0, 1, 2**16, 10**12, 2**63, 10**40)
ALTERNATING: Final = "every other value NaN"
ALL: Final = -1


def extreme(draws: Draws, folder: Path) -> object:  # noqa: ARG001
    """One extreme number in one call; raises ArithmeticError for a result that is not finite."""
    name, path, value = variations()[draws.number % len(variations())]
    arguments, call = cases()[name]
    found = call(_replaced(arguments, path, value))
    if not all(np.isfinite(each).all() for each in _arrays(found)):
        raise ArithmeticError(f"{name}, {path} = {value!r}: not finite, without an error")
    return name, path, value


@functools.lru_cache
def variations() -> tuple[tuple[str, tuple[Any, ...], Any], ...]:
    """Name of a case, place of the number in its arguments, and the extreme value there.

    They are shuffled, so that the first of them are a sample of all.
    """
    found = [
        (name, path, value)
        for name, (arguments, _) in cases().items()
        for path, old in _numbers(arguments)
        for value in _values(old)
    ]
    random.Random(0).shuffle(found)  # noqa: S311
    return tuple(found)


def _values(old: Any) -> tuple[Any, ...]:
    if isinstance(old, np.ndarray):
        return (*REALS, ALTERNATING)
    return WHOLES if isinstance(old, int) else REALS


def _numbers(tree: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Places and values of all numbers in the arguments; of items alike the first two."""
    if isinstance(tree, bool | str) or tree is None:
        return
    if isinstance(tree, int | float | complex):
        yield path, tree
    elif isinstance(tree, np.ndarray):
        if tree.dtype.kind in "fc":
            yield (*path, ALL), tree
            yield (*path, tree.size // 2), tree
    elif isinstance(tree, Mapping):
        for key, value in tree.items():
            yield from _numbers(value, (*path, key))
    elif isinstance(tree, tuple | list):
        for item in range(min(len(tree), 2)):
            yield from _numbers(tree[item], (*path, item))
    elif dataclasses.is_dataclass(tree):
        for field in dataclasses.fields(tree):
            if field.init:
                yield from _numbers(getattr(tree, field.name), (*path, field.name))


def _replaced(tree: Any, path: tuple[Any, ...], value: Any) -> Any:
    """Copy of the arguments with another number; dataclasses check themselves."""
    if not path:
        return value
    first, *rest = path
    if isinstance(tree, np.ndarray):
        changed = tree.copy()
        if value == ALTERNATING:
            changed.flat[::2] = np.nan
        elif first == ALL:
            changed[:] = value
        else:
            changed.flat[first] = value
        return changed
    if isinstance(tree, Mapping):
        return {**tree, first: _replaced(tree[first], tuple(rest), value)}
    if isinstance(tree, tuple | list):
        items = list(tree)
        items[first] = _replaced(items[first], tuple(rest), value)
        return type(tree)(items)
    inner = _replaced(getattr(tree, first), tuple(rest), value)
    return dataclasses.replace(tree, **{first: inner})


def _arrays(found: Any) -> Iterator[Any]:
    """Numbers and arrays of a result."""
    if isinstance(found, tuple | list):
        for each in found:
            yield from _arrays(each)
    elif isinstance(found, np.ndarray):
        yield found if found.dtype.kind in "fciu" else np.zeros(0)
    elif isinstance(found, int | float | complex):
        yield np.abs(complex(found)) if abs(found) < 1e300 else np.array(np.inf)
