"""Hostile texts: TOML, JSON and tables of electrodes, misworded at random."""

import json
import random
from collections.abc import Callable, Mapping
from pathlib import Path

from eitskin.benchmarks.studies.hostile.mutations import damaged, misworded
from eitskin.benchmarks.studies.hostile.parsers import PARSERS, Parser


class Draws(random.Random):
    """Random numbers of a trial, and its number."""

    def __init__(self, seed: str, number: int) -> None:
        super().__init__(seed)
        self.number = number


Trial = Callable[[Draws, Path], object]
"""One hostile input: made from random numbers in a folder, and read."""


def texts() -> Mapping[str, Trial]:
    """Trials of texts by kind."""
    changes = {"TOML": _reworded, "protocols": _reworded_or_damaged, "manifests": broken_json}
    changes["stored references"] = broken_json
    return {
        kind: _trial(PARSERS[kind], change)
        for start, change in changes.items()
        for kind in PARSERS
        if kind.startswith(start)
    }


def _trial(parser: Parser, change: Callable[[random.Random, bytes], bytes]) -> Trial:
    def trial(rng: Draws, folder: Path) -> object:
        return parser.parse(change(rng, rng.choice(parser.good())), folder)

    return trial


def _reworded(rng: random.Random, good: bytes) -> bytes:
    return misworded(rng, good.decode()).encode()


def _reworded_or_damaged(rng: random.Random, good: bytes) -> bytes:
    return _reworded(rng, good) if rng.random() < 0.6 else damaged(rng, good)


def broken_json(rng: random.Random, good: bytes) -> bytes:
    """JSON with other values, or damaged."""
    if rng.random() < 0.3:
        return damaged(rng, good)
    return misworded(rng, json.dumps(json.loads(good), indent=0)).encode()
