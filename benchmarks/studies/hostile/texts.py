"""Hostile texts: TOML, JSON and tables of electrodes, misworded at random."""

import json
import random
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from eitskin.benchmarks.studies.hostile.mutations import damaged, misworded
from eitskin.config import parse_toml, to_toml
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.recipe.shipped_recipes import shipped_names
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.folder import save_dataset
from eitskin.datasets.store.manifest import read_manifest
from eitskin.geometry.deformation.fixtures import Clamp, Fixture, FreeArc, Hinge
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.hardware.virtual.scene_script import Script
from eitskin.protocol import Protocol
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.scene.scene import Scene
from eitskin.training.pipeline.stored_reference import StoredReference, Zero
from eitskin.training.twin.parameters import TwinPrior


class Draws(random.Random):
    """Random numbers of a trial, and its number."""

    def __init__(self, seed: str, number: int) -> None:
        super().__init__(seed)
        self.number = number


Trial = Callable[[Draws, Path], object]
"""One hostile input: made from random numbers in a folder, and read."""

SCENE = """[bend]
angle_deg = 20.0
[[touches]]
x = 0.05
y = 0.03
force = 5.0
[[touches]]
x = 0.02
y = 0.02
depth = 0.001
indenter = { radius = 0.005 }
"""
SCRIPT = "repeat = true\n[[steps]]\nframes = 10\n[steps.scene]\nbend = { angle_deg = 5.0 }\n"


def texts() -> Mapping[str, Trial]:
    """Trials of texts by kind."""
    kinds: dict[str, tuple[Any, Callable[[], tuple[str, ...]]]] = {
        "designs": (SensorDesign, _designs),
        "scenes": (Scene, lambda: (SCENE,)),
        "recipes": (Recipe, _recipes),
        "fixtures": (Fixture, _fixtures),
        "mechanics": (Mechanics, lambda: (to_toml(Mechanics()),)),
        "instruments": (Instrument, lambda: (to_toml(Instrument.ad5940()),)),
        "priors of twins": (TwinPrior, lambda: (to_toml(TwinPrior()),)),
    }
    found: dict[str, Trial] = {f"TOML: {name}": _toml(*each) for name, each in kinds.items()}
    return found | {
        "TOML: scripts of scenes": _script,
        "protocols (CSV)": _protocol,
        "manifests (JSON)": _manifest,
        "stored references (JSON)": _reference,
    }


def _toml(kind: Any, texts: Callable[[], tuple[str, ...]]) -> Trial:
    def trial(rng: Draws, folder: Path) -> object:
        return parse_toml(kind, misworded(rng, rng.choice(texts())), folder=folder)

    return trial


@lru_cache
def _designs() -> tuple[str, ...]:
    recipes = [Recipe.shipped(name) for name in shipped_names()]
    return tuple({to_toml(SensorDesign.reference()), *(to_toml(each.sensor) for each in recipes)})


@lru_cache
def _recipes() -> tuple[str, ...]:
    return tuple(Recipe.shipped(name).to_toml() for name in shipped_names())


@lru_cache
def _fixtures() -> tuple[str, ...]:
    return tuple(to_toml(each) for each in (Clamp(), FreeArc(0.1), Hinge()))


def _script(rng: Draws, folder: Path) -> object:
    path = folder / "script.toml"
    path.write_text(misworded(rng, SCRIPT), encoding="utf-8", errors="surrogateescape")
    return Script.from_toml(path)


def _protocol(rng: Draws, folder: Path) -> object:
    path = folder / "protocol.csv"
    Protocol.adjacent(8).to_file(path)
    content = path.read_bytes()
    text = rng.random() < 0.6
    path.write_bytes(misworded(rng, content.decode()).encode() if text else damaged(rng, content))
    return Protocol.from_file(path, 8)


def small_dataset(frames: int = 12) -> Dataset:
    """A few frames of nothing in particular, with something in most arrays."""
    rng = np.random.default_rng(0)
    touch = np.full((frames, 4), np.nan)
    touch[::2, 0] = 0.03
    return Dataset.from_arrays(
        500 + rng.normal(size=(frames, 28)) * (1 + 0.1j),
        np.full((1, 28), 500.0),
        touch_x=touch,
        touch_y=touch,
        state=np.arange(frames) % 3,
        bend_angle_deg=np.zeros(frames),
        protocol=Protocol.pairwise(8),
        design=SensorDesign.reference(),
    )


def _manifest(rng: Draws, folder: Path) -> object:
    path = folder / "set" / "manifest.json"
    good = folder / "good.json"
    if not good.exists():
        save_dataset(small_dataset(), folder / "set", frames_per_shard=4)
        good.write_bytes(path.read_bytes())
    path.write_bytes(broken_json(rng, good.read_bytes()))
    return read_manifest(folder / "set")


def _reference(rng: Draws, folder: Path) -> object:
    path, good = folder / "reference.json", folder / "good-reference.json"
    if not good.exists():
        made = StoredReference(
            np.full(28, 500 + 1j), Protocol.pairwise(8), 40e3, Zero.FLAT, 5, 1e-4, "2026-11-24"
        )
        made.write(good)
    path.write_bytes(broken_json(rng, good.read_bytes()))
    return StoredReference.read(path)


def broken_json(rng: random.Random, good: bytes) -> bytes:
    """JSON with other values, or damaged."""
    if rng.random() < 0.3:
        return damaged(rng, good)
    return misworded(rng, json.dumps(json.loads(good), indent=0)).encode()
