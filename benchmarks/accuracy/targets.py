"""Targets of the named resolutions."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Target:
    """Target of a named resolution on one core; errors as in `Judgement`."""

    name: str
    resistance_error: float | None
    signal_error: float
    seconds: float


TARGETS = (
    Target("fast", None, 2e-2, 0.010),
    Target("standard", 1e-3, 1e-2, 0.050),
    Target("fine", 1e-5, 1e-4, 5.0),
)
TARGET_RATIO = 20.0
