"""Compiled kernels: loops that numba compiles, used for many scenes where numba is installed.

Every kernel has a plain twin in numpy beside the place where it is used, which runs for single
scenes, without numba (extra `fast`), or where the environment variable EITSKIN_PLAIN is set. Both
agree to rounding.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import TypeVar, cast

Loop = TypeVar("Loop", bound=Callable[..., object])

_wanted: ContextVar[bool] = ContextVar("_wanted", default=False)


@contextmanager
def kernels() -> Iterator[None]:
    """Context in which `compiled` gives kernels.

    Loading them takes half a second, as long as some scenes take without: a command that simulates
    one scene is faster plain.
    """
    before = _wanted.set(True)
    try:
        yield
    finally:
        _wanted.reset(before)


def compiled(module: str) -> ModuleType | None:
    """Module of kernels by its name; None without numba, and outside of `kernels`."""
    return loaded(module) if _wanted.get() else None


@cache
def loaded(module: str) -> ModuleType | None:
    """Module of kernels by its name; None without numba.

    The first import compiles them, in some seconds; what it compiles is kept on the disk beside the
    module, or in the user's cache folder.
    """
    if os.environ.get("EITSKIN_PLAIN") or find_spec("numba") is None:
        return None
    return import_module(module)


def kernel(types: str) -> Callable[[Loop], Loop]:
    """Decorator that compiles a function of numbers and contiguous arrays of these types.

    There is one version of every kernel: processes that compiled others at the same time could mix
    them up on the disk.
    """
    from numba import njit

    # Sums may be taken in another order and products contracted; infinities and NaN keep meaning.
    flags = {"contract", "reassoc", "nsz", "arcp"}
    made = njit(types, cache=True, error_model="numpy", fastmath=flags)
    return cast("Callable[[Loop], Loop]", made)
