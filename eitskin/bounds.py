"""Bounds of user input: lengths, counts and positive numbers.

A length beyond the bounds was most likely given in another unit.
"""

import math
from typing import TYPE_CHECKING, Any

from eitskin.errors import ConfigurationError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

SHORTEST, LONGEST = 1e-6, 10.0
LEAST, MOST = 1e-15, 1e15
"""Bounds of positive quantities in SI units, beyond which sums of them lose all digits."""

LEAST_READING, LARGEST_READING = 1e-12, 1e12
"""Magnitudes of a reading [ohm], or of another quantity; the square of others may overflow."""

MOST_ELECTRODES, MOST_POINTS = 1024, 4096

MAX_SEED = 2**63 - 1


def require_positive(name: str, value: float, unit: str) -> None:
    """Raise ConfigurationError unless `value` is above zero, and within `LEAST` and `MOST`."""
    if not (math.isfinite(value) and value > 0):
        raise ConfigurationError(f"{name} must be a positive number of {unit}, got {value!r}")
    if not LEAST <= value <= MOST:
        raise ConfigurationError(
            f"{name} must be between {LEAST:g} and {MOST:g} {unit}, got {value!r}"
        )


def require_length(name: str, value: float, longest: float = LONGEST) -> None:
    """Raise ConfigurationError unless `value` [m] is a length up to `longest` [m]."""
    require_positive(name, value, "m")
    if not SHORTEST <= value <= longest:
        raise ConfigurationError(
            f"{name} must be between {SHORTEST * 1e6:g} um and {longest:g} m, got {value:g} m; "
            "lengths are in metres, so 5 mm is 0.005"
        )


def require_in_range(name: str, value: float, low: float, high: float, unit: str = "") -> None:
    """Raise ConfigurationError unless `value` is a number from `low` to `high`."""
    if not low <= value <= high:
        limits = f"from {low:g} to {high:g} {unit}".rstrip()
        raise ConfigurationError(f"{name} must be {limits}, got {value}")


def require_count(name: str, value: int, minimum: int, maximum: int) -> None:
    """Raise ConfigurationError unless `value` is from `minimum` to `maximum`."""
    if not minimum <= value <= maximum:
        raise ConfigurationError(f"{name} must be from {minimum} to {maximum}, got {value}")


def require_axes(
    name: str, values: "NDArray[Any]", *lengths: int | None, more: bool = True
) -> None:
    """Raise ConfigurationError unless the last axes of an array have these lengths; None is any.

    Without `more`, they are all axes.
    """
    extra = values.ndim - len(lengths)
    axes = zip(lengths, values.shape[max(0, extra) :], strict=False)
    if extra < 0 or (extra and not more) or any(each not in (None, axis) for each, axis in axes):
        wanted = ", ".join("n" if length is None else str(length) for length in lengths)
        raise ConfigurationError(
            f"{name}: expected the shape ({'..., ' * more}{wanted}), got {values.shape}"
        )


def require_seed(value: int) -> None:
    """Raise ConfigurationError unless `value` may seed random numbers."""
    if not 0 <= value <= MAX_SEED:
        raise ConfigurationError(f"seed must be from 0 to 2^63 - 1, got {value}")


def sample_uniform(
    rng: "np.random.Generator", limits: tuple[float, float], size: int | None = None
) -> Any:
    """Uniform random numbers between limits, of which the second may be -0.0.

    For NumPy the range from 0.0 to -0.0 is none.
    """
    low, high = limits
    return rng.uniform(low, high + 0.0, size)
