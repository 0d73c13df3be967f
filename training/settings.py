"""What a training run is told: hyper-parameters of the networks, and the seed."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from eitskin.geometry import ConfigurationError

Progress = Callable[[str, int, int], None]
"""Called with the name of a stage, how much of it is done and how much there is."""


def silent(stage: str, done: int, total: int) -> None:
    """A progress callback that says nothing."""


@dataclass(frozen=True, slots=True)
class NetworkSettings:
    """How one network is trained, with Adam.

    Attributes:
        learning_rate: the highest one where `one_cycle`.
        epochs: passes over the training frames.
        batch: frames per step.
        one_cycle: warm up to the learning rate and anneal to nothing, instead of keeping it.
        noise: rms of fresh noise on dV in every step, in units of the noise of the frames.
    """

    learning_rate: float
    epochs: int
    batch: int = 64
    one_cycle: bool = True
    noise: float = 0.0

    def __post_init__(self) -> None:
        """Check the numbers."""
        if not (self.learning_rate > 0 and self.epochs > 0 and self.batch > 0 and self.noise >= 0):
            raise ConfigurationError(
                "learning_rate, epochs and batch must be positive and noise not negative, got "
                f"{self}"
            )


@dataclass(frozen=True, slots=True)
class TrainingSettings:
    """How a pipeline is trained.

    Attributes:
        classifier: of the three states.
        postprocessor: of the touch map.
        bend_free_map: whether the classifier also sees a map that bending leaves dark.
        seed: of the split, the initial weights, the order of frames and added noise.
    """

    classifier: NetworkSettings = NetworkSettings(1e-3, epochs=25, noise=0.5)
    postprocessor: NetworkSettings = NetworkSettings(3e-3, epochs=40, batch=32, noise=0.5)
    bend_free_map: bool = True
    seed: int = 0

    @classmethod
    def preset(cls, name: str, seed: int = 0) -> "TrainingSettings":
        """Settings by name: "quick", ours, or "paper", whose classifier is trained as published.

        The paper gives Adam at 1e-5, batches of 64 and 150 epochs for the classifier, and no
        settings for its post-processor, which is ours in both.
        """
        if name == "quick":
            return cls(seed=seed)
        if name == "paper":
            classifier = NetworkSettings(1e-5, epochs=150, batch=64, one_cycle=False)
            return cls(classifier=classifier, bend_free_map=False, seed=seed)
        raise ConfigurationError(f"preset must be 'quick' or 'paper', got '{name}'")

    def with_epochs(self, epochs: int) -> "TrainingSettings":
        """The same with another number of passes for both networks."""
        return replace(
            self,
            classifier=replace(self.classifier, epochs=epochs),
            postprocessor=replace(self.postprocessor, epochs=epochs),
        )
