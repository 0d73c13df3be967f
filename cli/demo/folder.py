"""A demo's plan, and the folder that it is carried out in."""

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
from eitskin.cli.commands.train import train_pipeline
from eitskin.cli.episode import FRAMES
from eitskin.cli.options import Output
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.folder import make_folder, open_dataset
from eitskin.errors import DataError
from eitskin.files import remove_leftovers

if TYPE_CHECKING:
    from eitskin.training.pipeline.pipeline import Pipeline

MODEL = "demo.eitmodel"
RESULTS = "results"
MADE_WITH = ("eitskin", "numpy", "scipy", "torch")
SETS = ("quick", "quick_test", "paper_indentation")
HERE, SHIPPED = "trained here", "shipped"


@dataclass(frozen=True, slots=True)
class Plan:
    """What a demo makes.

    Attributes:
        recipes: of the sets to train on, to test on and of single touches on a grid, as `SETS`.
        seed: of everything random.
        epochs: passes over the frames in training, instead of the preset's.
        episode_frames: that each step of the live episode lasts.
    """

    recipes: Mapping[str, Recipe]
    seed: int = 0
    epochs: int | None = None
    episode_frames: int = FRAMES

    @classmethod
    def standard(cls, seed: int) -> "Plan":
        """That of `make demo`: the shipped recipes, all test frames from the finer mesh."""
        recipes = {name: Recipe.shipped(name) for name in SETS}
        recipes["paper_indentation"] = dataclasses.replace(
            recipes["paper_indentation"], resolution="standard"
        )
        seeded = {
            name: dataclasses.replace(recipe, seed=recipe.seed + seed)
            for name, recipe in recipes.items()
        }
        return cls(seeded, seed)


class Demo:
    """A plan, the folder that it is carried out in, and what lies there so far.

    Attributes:
        plan: what to make.
        out: the folder.
        data: folder of real recordings; None without.
        workers: processes that simulate.
        output: where progress is shown.
    """

    def __init__(
        self, plan: Plan, out: Path, data: Path | None, workers: int, output: Output
    ) -> None:
        """Make the folder, and clear away what a killed demo left half-written."""
        self.plan, self.out, self.data = plan, out, data
        self.workers, self.output = workers, output
        self._pipelines: dict[str, Pipeline] = {}
        make_folder(out / RESULTS)
        remove_leftovers(out / RESULTS)

    @cached_property
    def sets(self) -> dict[str, Dataset]:
        """The datasets by name; shards that lie there are kept."""
        return {name: self._dataset(name, recipe) for name, recipe in self.plan.recipes.items()}

    def _dataset(self, name: str, recipe: Recipe) -> Dataset:
        folder = self.out / name
        _, sentence = make_dataset(
            recipe, folder, self.workers, resume=folder.exists(), output=self.output
        )
        self.output.show(sentence)
        return open_dataset(folder)

    @cached_property
    def frames(self) -> dict[str, str]:
        """SHA-256 of the frames of each set."""
        from eitskin.training.method.observations import fingerprint

        return {name: fingerprint(data) for name, data in self.sets.items()}

    @property
    def model(self) -> Path:
        """Where the pipeline is saved that is trained here."""
        return self.out / MODEL

    @cached_property
    def weights(self) -> dict[str, str]:
        """SHA-256 of the weights of both pipelines; the one trained here is trained if need be."""
        from eitskin.training.pipeline.saved_form import SHIPPED as COMES_ALONG

        if not self._trained():
            self._train()
        return {HERE: _weights(self.model), SHIPPED: _weights(COMES_ALONG)}

    def pipeline(self, which: str) -> "Pipeline":
        """One of the two, as it was saved, at the beginning of a session."""
        from eitskin.training.pipeline.pipeline import Pipeline

        if which not in self._pipelines:
            path = self.model if which == HERE else Path("reference.eitmodel")
            self._pipelines[which] = Pipeline.load(path)
        return dataclasses.replace(self._pipelines[which])

    def _trained(self) -> bool:
        """Whether a pipeline lies there that was trained on the same, in the same way."""
        from eitskin.training.pipeline.saved_form import read_pipeline

        try:
            document = read_pipeline(self.model).document
        except DataError:
            return False
        return bool(document["metrics"].get("training", {}).get("made_from") == self._lessons)

    @property
    def _lessons(self) -> dict[str, Any]:
        """Everything that decides over the pipeline that is trained here."""
        lessons = {"frames": self.frames["quick"], "epochs": self.plan.epochs}
        return {"versions": made_with(), "seed": self.plan.seed, **lessons}

    def _train(self) -> None:
        start = time.perf_counter()
        plan = self.plan
        trained = train_pipeline(self.sets["quick"], "quick", plan.epochs, plan.seed, self.output)
        seconds = round(time.perf_counter() - start, 1)
        trained.metrics["training"] = {"made_from": self._lessons, "seconds": seconds}
        self.output.show(f"saved pipeline: {trained.save(self.model)}")


def made_with() -> dict[str, str]:
    """Versions of what decides over the numbers."""
    return {name: version(name) for name in MADE_WITH}


def _weights(path: Path) -> str:
    """SHA-256 of the weights of a saved pipeline."""
    return hashlib.sha256((path / "weights.safetensors").read_bytes()).hexdigest()
