"""Scenes and signal strengths of the shipped recipes.

Run by `python -m eitskin.benchmarks.studies.data.recipes`.

Draws two pictures into --out: `recipes.png`, statistics of each recipe, and `episodes.png`, one
episode of each that has any; and prints, as Markdown, medians of signal and noise. Signals are of
frames simulated here, a few hundred of each recipe, spread over all of it.
"""

import argparse
import dataclasses
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.studies.data.recipes_plot import Strength, plot_episodes, plot_statistics
from eitskin.datasets.generation.preparation import prepare
from eitskin.datasets.generation.shard_simulation import simulate_frames
from eitskin.datasets.recipe.frame_sampling import Sample, sample
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.datasets.recipe.shipped_recipes import shipped_names
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.state import State
from eitskin.provenance import Provenance

Array = NDArray[np.float64]

DRAWN = 3000  # frames at most, of which only scenes are drawn


def strength_of(recipe: Recipe, frames: int) -> Strength:
    """Strength of a recipe, from some of its frames and as many of its sensors untouched."""
    data = simulate_frames(recipe, spread(recipe.frames, frames))
    flat = (SceneGroup("idle", count=frames),)
    alone = simulate_frames(dataclasses.replace(recipe, scenes=flat, episodes=()), range(frames))
    bend, touch = changes(data)
    _, noise = changes(alone)
    return Strength(
        bend=_rms(bend[data.state == State.BEND]),
        touch=_rms(touch[data.touch_count > 0]),
        noise=_rms(noise) / np.sqrt(2.0),  # the touch reference has as much
    )


def changes(data: Dataset) -> tuple[Array, Array]:
    """Changes from the flat and from the untouched sensor over the flat magnitude, (n, C)."""
    flat = data.reference[data.specimen]
    size = np.abs(flat)
    return (data.impedance - flat).real / size, (data.impedance - data.touch_reference).real / size


def main() -> None:
    """Draw and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder for the pictures")
    parser.add_argument("--frames", type=int, default=200, help="how many to simulate of each")
    parser.add_argument("--only", help="name of the one recipe to look at, instead of all")
    arguments = parser.parse_args()
    rows, episodes = [], []
    print("| recipe | bend | touch | noise of one frame |\n|---|---|---|---|")
    for name in [arguments.only] if arguments.only else shipped_names():
        recipe = Recipe.shipped(name)
        prepare(recipe)
        strength = strength_of(recipe, arguments.frames)
        rows.append((recipe, drawn(recipe), strength))
        print(row(recipe, strength), flush=True)
        if recipe.episodes:
            episodes.append((name, simulate_frames(recipe, first_episode(recipe))))
    plot_statistics(rows, arguments.out / "recipes.png")
    plot_episodes(episodes, arguments.out / "episodes.png")
    print(f"\n{Provenance.now(0)}")


def drawn(recipe: Recipe) -> list[Sample]:
    """Scenes spread over the whole of a recipe, at most `DRAWN`."""
    return [sample(recipe, index) for index in spread(recipe.frames, DRAWN)]


def spread(frames: int, most: int) -> list[int]:
    """Numbers of at most `most` frames, evenly spread."""
    return sorted(set(np.linspace(0, frames - 1, most).astype(int).tolist()))


def first_episode(recipe: Recipe) -> range:
    """Numbers of the frames of a recipe's first episode."""
    return range(recipe.snapshots, recipe.snapshots + recipe.episodes[0].frames)


def row(recipe: Recipe, strength: Strength) -> str:
    """Row of a Markdown table: medians over the measurements."""
    bend, touch, noise = (
        100.0 * float(np.median(part)) for part in (strength.bend, strength.touch, strength.noise)
    )
    cells = [f"{bend:.1f} %", f"{touch:.2f} %", f"{noise:.3f} %"]
    shown = ("-" if cell.startswith("nan") else cell for cell in cells)
    return f"| `{recipe.name}` | {' | '.join(shown)} |"


def _rms(values: NDArray[np.floating]) -> Array:
    if not len(values):
        return np.full(values.shape[1], np.nan)
    return np.asarray(np.sqrt(np.mean(values.astype(np.float64) ** 2, axis=0)))


if __name__ == "__main__":
    main()
