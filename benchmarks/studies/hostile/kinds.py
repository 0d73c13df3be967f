"""Kinds of hostile inputs, and how many of each are tried."""

from collections.abc import Mapping
from typing import Final

from eitskin.benchmarks.studies.hostile.boards import boards
from eitskin.benchmarks.studies.hostile.extremes import extreme
from eitskin.benchmarks.studies.hostile.files import PARTS, SURFACES, files
from eitskin.benchmarks.studies.hostile.kills import killed
from eitskin.benchmarks.studies.hostile.texts import Draws, Trial, texts

_TRIALS: Final[Mapping[str, Trial]] = {
    **texts(),
    **files(),
    **boards(),
    "extreme numbers": extreme,
    "kills of a generation": killed,
}
_SHARES: Final[Mapping[str, float]] = {
    **dict.fromkeys((f"saved pipelines: {part}" for part in PARTS), 0.25),
    **dict.fromkeys((f"saved touch positions: {part}" for part in PARTS), 0.25),
    **dict.fromkeys((f"surfaces: {ending}" for ending in SURFACES), 0.34),
    "replayed recordings (HDF5)": 0.1,
    "sessions": 0.03,
    "extreme numbers": 0.64,
    "kills of a generation": 0.1,
}

KINDS: Final[Mapping[str, float]] = {kind: _SHARES.get(kind, 1.0) for kind in _TRIALS}
"""Kinds, with their share of the number of trials."""


def trial(kind: str) -> Trial:
    """Maker and reader of inputs of a kind."""
    return _TRIALS[kind]


def draws(seed: int, kind: str, number: int) -> Draws:
    """Random numbers of a trial."""
    return Draws(f"{seed} {kind} {number}", number)
