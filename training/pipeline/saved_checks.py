"""Checks of the numbers of a saved pipeline, which its golden outputs do not all cover."""

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import DataError
from eitskin.files import quoted

DAMAGE: Final = (
    ArithmeticError,
    AttributeError,
    LookupError,
    RecursionError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""Errors by which arrays of wrong shapes and documents of wrong types are noticed."""

_LARGEST: Final = 1e30  # beyond which products in single precision overflow
_WIDEST_ANGLE: Final = 360.0  # deg; the fit looks at every few degrees of the range
_MOST_EXAMPLES: Final = 4096  # golden frames, which are computed when a pipeline is opened
_LARGEST_NOISE: Final = 1.0


def require_possible(
    weights: Mapping[str, NDArray[Any]], golden: Mapping[str, NDArray[Any]], noise: float = 0.0
) -> None:
    """Raise DataError for numbers that no training gives.

    Args:
        weights: arrays of the pipeline by name: no NaN and nothing immense, angles within a turn;
            minus infinity is the logarithm of an impossible place.
        golden: arrays by which the pipeline is checked: few frames.
        noise: rms of the relative difference of two frames.
    """
    for name, array in weights.items():
        if array.dtype.kind not in "biufc":
            raise DataError(f"expected numbers in '{name}', got {array.dtype}; train it again")
        if array.dtype.kind in "fc" and not _plausible(array):
            raise DataError(
                f"expected finite numbers up to {_LARGEST:g} in '{name}', got others; train it "
                "again"
            )
        if name.endswith("angle_deg") and np.any(np.abs(array) > _WIDEST_ANGLE):
            raise DataError(
                f"expected angles up to {_WIDEST_ANGLE:g} deg in '{name}', got "
                f"{float(np.abs(array).max()):g}; train it again"
            )
    for name, array in golden.items():
        if array.ndim and len(array) > _MOST_EXAMPLES:
            raise DataError(
                f"expected at most {_MOST_EXAMPLES} golden frames in '{name}', got {len(array)}; "
                "save the pipeline again"
            )
    if not 0 <= noise <= _LARGEST_NOISE:
        raise DataError(f"expected a noise from 0 to {_LARGEST_NOISE:g}, got {noise:g}")


def number(document: Mapping[str, Any], name: str) -> float:
    """Finite number of a document; raises DataError for anything else."""
    value = document.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise DataError(f"expected a finite number as '{name}', got {quoted(value)}")
    return float(value)


def _plausible(array: NDArray[Any]) -> bool:
    with np.errstate(invalid="ignore"):
        size = np.abs(array)
        impossible = (array == -np.inf) if array.dtype.kind == "f" else np.zeros(array.shape, bool)
        return bool(np.all((size <= _LARGEST) | impossible))
