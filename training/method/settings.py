"""What a training run is told: hyper-parameters of the networks, and the seed."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from eitskin.errors import ConfigurationError

METHODS = ("joint", "paper")

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
        if not (self.learning_rate > 0 and self.epochs > 0 and self.batch > 0 and self.noise >= 0):
            raise ConfigurationError(
                "learning_rate, epochs and batch must be positive and noise not negative, got "
                f"{self}"
            )


@dataclass(frozen=True, slots=True)
class JointSettings:
    """How the joint method learns its model of the sensor.

    Attributes:
        response: training of the network that says what touches do.
        proposals: training of the network whose places the fit starts from; an epoch is a hundred
            steps, on frames made up from the learned model.
        drift: standard deviation after four hours of the factor that all measurements of a session
            share: the gel dries and warms by a percent or two, the electronics drift by 0.2 %.
    """

    response: NetworkSettings = NetworkSettings(6e-3, epochs=60, batch=512)
    proposals: NetworkSettings = NetworkSettings(2e-3, epochs=40, batch=512)
    drift: float = 0.02

    def __post_init__(self) -> None:
        """Check the drift."""
        if not 0.0 <= self.drift <= 1.0:
            raise ConfigurationError(f"drift must be from 0 to 1 in four hours, got {self.drift}")


@dataclass(frozen=True, slots=True)
class TrainingSettings:
    """How a pipeline is trained.

    Attributes:
        method: "joint", which fits a learned model of the sensor to each frame, or "paper", the
            stages of the paper.
        joint: of the joint method.
        classifier: of the three states.
        postprocessor: of the touch map.
        bend_free_map: whether the classifier also sees a map that bending leaves dark.
        compressed_maps: whether it sees asinh of maps, instead of standardised ones.
        bend_squares: whether the regression of the angle may also select squares of dV.
        seed: of the split, the initial weights, the order of frames and added noise.
    """

    method: str = "paper"
    joint: JointSettings = JointSettings()
    classifier: NetworkSettings = NetworkSettings(1e-3, epochs=25, noise=0.5)
    postprocessor: NetworkSettings = NetworkSettings(3e-3, epochs=40, batch=32, noise=0.5)
    bend_free_map: bool = True
    compressed_maps: bool = True
    bend_squares: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the method."""
        if self.method not in METHODS:
            raise ConfigurationError(
                f"method must be one of {', '.join(METHODS)}, got '{self.method}'"
            )

    @property
    def fractions(self) -> tuple[float, float, float]:
        """Training, validation and test part of a dataset: the paper's 60/20/20.

        The joint method learns from four fifths, and validates on a part of those.
        """
        return (0.8, 0.1, 0.1) if self.method == "joint" else (0.6, 0.2, 0.2)

    @classmethod
    def preset(cls, name: str, seed: int = 0) -> "TrainingSettings":
        """Settings by name: "joint", "quick" or "paper".

        "paper" is the paper in every stage; `PaperMethod` lists what that leaves open. "quick" has
        the same stages, trained faster, a classifier that also sees a map which bending leaves
        dark, both compressed, and an angle that may be curved in dV.
        """
        if name == "joint":
            return cls(method="joint", seed=seed)
        if name == "quick":
            return cls(seed=seed)
        if name == "paper":
            classifier = NetworkSettings(1e-5, epochs=150, batch=64, one_cycle=False)
            return cls(
                classifier=classifier,
                bend_free_map=False,
                compressed_maps=False,
                bend_squares=False,
                seed=seed,
            )
        raise ConfigurationError(f"preset must be 'joint', 'quick' or 'paper', got '{name}'")

    def with_epochs(self, epochs: int) -> "TrainingSettings":
        """The same with another number of passes for all networks."""
        return replace(
            self,
            joint=replace(self.joint, response=replace(self.joint.response, epochs=epochs)),
            classifier=replace(self.classifier, epochs=epochs),
            postprocessor=replace(self.postprocessor, epochs=epochs),
        )
