"""Compiled kernels: loops that numba compiles, used where numba is installed (extra `fast`).

Every kernel has a plain twin in numpy beside the place where it is used, which runs without numba
or where the environment variable EITSKIN_PLAIN is set; both agree to rounding.
"""

import os
from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import TypeVar, cast

Loop = TypeVar("Loop", bound=Callable[..., object])


@cache
def compiled(module: str) -> ModuleType | None:
    """Module of kernels by its name; None without numba.

    numba is imported by the first call, which takes 0.2 s. The first call of a kernel compiles it;
    what it compiles is kept on disk beside the module, or in the user's cache folder.
    """
    if os.environ.get("EITSKIN_PLAIN") or find_spec("numba") is None:
        return None
    return import_module(module)


def kernel(loop: Loop) -> Loop:
    """Compile a function of arrays and numbers, at its first call for their types."""
    from numba import njit

    # Sums may be taken in another order and products contracted; infinities and NaN keep meaning.
    flags = {"contract", "reassoc", "nsz", "arcp"}
    return cast("Loop", njit(cache=True, error_model="numpy", fastmath=flags)(loop))
