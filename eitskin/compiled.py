"""Compiled kernels: loops that numba compiles, used for many scenes where numba is installed.

A module of kernels either has a reference implementation in numpy next to the place where it is
used (`kernel`, `compiled_kernels`), or is written so that it runs in both ways (`either`,
`implementation`). Plain code runs for single scenes, without numba (extra `fast`), or where the
environment variable EITSKIN_PLAIN is set. Both agree to rounding.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from importlib import import_module
from importlib.util import find_spec, module_from_spec
from types import ModuleType
from typing import TYPE_CHECKING, TypeVar, cast

if TYPE_CHECKING:
    from importlib.abc import Loader
    from importlib.machinery import ModuleSpec

Loop = TypeVar("Loop", bound=Callable[..., object])

_wanted: ContextVar[bool] = ContextVar("_wanted", default=False)


@contextmanager
def kernels() -> Iterator[None]:
    """Context in which `compiled_kernels` gives kernels.

    Loading them takes half a second: a command that simulates one scene is faster plain.
    """
    before = _wanted.set(True)
    try:
        yield
    finally:
        _wanted.reset(before)


def compiled_kernels(module: str) -> ModuleType | None:
    """Module of kernels by its name; None without numba, and outside of `kernels`."""
    return load_kernels(module) if _wanted.get() else None


@cache
def load_kernels(module: str) -> ModuleType | None:
    """Module of kernels by its name; None without numba.

    The first import compiles them; the result is kept next to the module or in the user's cache.
    """
    if os.environ.get("EITSKIN_PLAIN") or find_spec("numba") is None:
        return None
    return import_module(module)


def implementation(module: str) -> ModuleType:
    """Module of `either` functions by its name, compiled where `compiled_kernels` would be."""
    return _compiled_copy(module) if compiled_kernels("numba") else import_module(module)


@cache
def _compiled_copy(module: str) -> ModuleType:
    spec = cast("ModuleSpec", find_spec(module))
    copy = module_from_spec(spec)
    vars(copy)["COMPILED"] = True
    cast("Loader", spec.loader).exec_module(copy)
    return copy


def kernel(types: str) -> Callable[[Loop], Loop]:
    """Decorator that compiles a function of numbers and contiguous arrays of these types.

    There is one version of each: processes that compile several at once mix them up on the disk.
    """
    from numba import njit

    from eitskin.kernel_cache import use_cache

    # Sums may be taken in another order and products contracted; infinities and NaN keep meaning.
    flags = {"contract", "reassoc", "nsz", "arcp"}

    def compile_loop(function: Loop) -> Loop:
        compiled_function = njit(error_model="numpy", fastmath=flags)(function)
        use_cache(compiled_function, function)
        compiled_function.compile(types)
        compiled_function.disable_compile()
        return cast("Loop", compiled_function)

    return compile_loop


def either(types: str, library: object = None) -> Callable[[Loop], Loop]:
    """Decorator: a `kernel` in a compiled copy; else the function, or that of a library."""

    def decorate(function: Loop) -> Loop:
        compiles = "COMPILED" in function.__globals__
        return kernel(types)(function) if compiles else cast("Loop", library or function)

    return decorate
