"""Plan of a demo, and the folder with its datasets and pipelines."""

import dataclasses
import hashlib
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from eitskin.cli.commands.generate import make_dataset
from eitskin.cli.commands.train import choose, train_pipeline
from eitskin.cli.episode import FRAMES
from eitskin.cli.options import Output
from eitskin.datasets.recipe.recipe import Recipe, with_seed
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.folder import make_folder, open_dataset
from eitskin.errors import DataError
from eitskin.files import remove_leftovers
from eitskin.training.method.observations import fingerprint
from eitskin.training.pipeline.saved_form import SHIPPED as SHIPPED_MODEL
from eitskin.training.pipeline.saved_form import read_pipeline

if TYPE_CHECKING:
    from eitskin.training.pipeline.pipeline import Pipeline

RESULTS = "results"
PACKAGES = ("eitskin", "numpy", "scipy", "torch")
SETS = ("quick", "quick_test", "paper_indentation")
TRAINED, SHIPPED = "trained here", "shipped"


@dataclass(frozen=True, slots=True)
class Plan:
    """Choices that a demo is made by.

    Attributes:
        recipes: of the datasets for training, for tests and of touches on a grid, as `SETS`.
        seed: of everything random.
        epochs: passes over the frames in training, instead of the preset's.
        episode_frames: frames of each step of the live episode.
    """

    recipes: Mapping[str, Recipe]
    seed: int = 0
    epochs: int | None = None
    episode_frames: int = FRAMES

    @classmethod
    def standard(cls, seed: int) -> "Plan":
        """Plan of `make demo`: the shipped recipes, test frames from the finer mesh."""
        recipes = {name: Recipe.shipped(name) for name in SETS}
        seeded = {name: with_seed(each, each.seed + seed) for name, each in recipes.items()}
        grid = dataclasses.replace(seeded["paper_indentation"], resolution="standard")
        return cls(seeded | {"paper_indentation": grid}, seed)


class Workspace:
    """Folder of a demo, with its datasets and pipelines, made when they are first asked for.

    Attributes:
        plan: choices that the demo is made by.
        out: the folder.
        data: folder of real recordings; None without.
        workers: processes that simulate.
        output: where progress is shown.
    """

    def __init__(
        self, plan: Plan, out: Path, data: Path | None, workers: int, output: Output
    ) -> None:
        """Make the folder, and remove partial files of a demo that was killed."""
        self.plan, self.out, self.data = plan, out, data
        self.workers, self.output = workers, output
        self.model = out / "demo.eitmodel"
        make_folder(out / RESULTS)
        remove_leftovers(out / RESULTS)

    @cached_property
    def sets(self) -> dict[str, Dataset]:
        """Datasets by name; finished shards are kept."""
        for name, recipe in self.plan.recipes.items():
            folder = self.out / name
            _, sentence = make_dataset(recipe, folder, self.workers, folder.exists(), self.output)
            self.output.show(sentence)
        return {name: open_dataset(self.out / name) for name in self.plan.recipes}

    @cached_property
    def frames(self) -> dict[str, str]:
        """SHA-256 of the frames of each dataset."""
        return {name: fingerprint(data) for name, data in self.sets.items()}

    @cached_property
    def weights(self) -> dict[str, str]:
        """SHA-256 of the weights of both pipelines, after training where that is needed."""
        if not self.is_trained():
            self._train()
        return {TRAINED: _weights(self.model), SHIPPED: _weights(SHIPPED_MODEL)}

    def pipeline(self, which: str) -> "Pipeline":
        """Pipeline `TRAINED` or `SHIPPED` as it was saved, at the beginning of a session."""
        from eitskin.training.pipeline.pipeline import Pipeline

        return Pipeline.load(self.model if which == TRAINED else SHIPPED_MODEL)

    def is_trained(self) -> bool:
        """Whether the saved pipeline was trained on the same frames in the same way."""
        try:
            metrics = read_pipeline(self.model).document["metrics"]
        except DataError:
            return False
        return bool(metrics.get("training", {}).get("made_from") == self._training_inputs)

    @property
    def _training_inputs(self) -> dict[str, Any]:
        """Everything that the trained pipeline depends on."""
        inputs = {"frames": self.frames["quick"], "epochs": self.plan.epochs}
        return {"versions": versions(), "seed": self.plan.seed, **inputs}

    def _train(self) -> None:
        start = time.perf_counter()
        plan = self.plan
        pipeline = train_pipeline(
            self.sets["quick"],
            choose("quick", epochs=plan.epochs, seed=plan.seed),
            self.output,
        )
        seconds = round(time.perf_counter() - start, 1)
        pipeline.metrics["training"] = {"made_from": self._training_inputs, "seconds": seconds}
        self.output.show(f"saved pipeline: {pipeline.save(self.model)}")


def versions() -> dict[str, str]:
    """Versions of the packages that the numbers depend on."""
    return {name: version(name) for name in PACKAGES}


def _weights(path: Path) -> str:
    """SHA-256 of the weights of a saved pipeline."""
    return hashlib.sha256((path / "weights.safetensors").read_bytes()).hexdigest()
