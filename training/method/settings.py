"""Settings of a training run: method, hyper-parameters, seed, and the part that is held out."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.bounds import require_in_range, require_seed
from eitskin.datasets import Dataset
from eitskin.extras import old_names
from eitskin.geometry import ConfigurationError

HELD_OUT_SHARE = 0.2  # of the specimens, or of the frames of one
BASELINES = ("ridge", "mlp", "extra-trees", "greit")
"""Names of methods to compare others with, and of their presets."""

POSITIONS = "touch position"
"""Name of the method that learns positions of touches alone, with or without a design."""

METHODS = ("joint", "paper", *BASELINES, POSITIONS)
"""Names of the methods that come with eitskin; those of others have a colon in their name."""

PRESETS = ("joint", "quick", "paper", *BASELINES)
_OPEN_CHOICES = ("bend_free_map", "compressed_maps", "bend_squares", "weighted", "mirrored")
POSITION_SHARE = 0.8  # neighbours in time are too similar to test on

Progress = Callable[[str, int, int], None]
"""Callback with the name of a stage, the steps done and their total number."""


def hold_out(dataset: Dataset, seed: int = 0) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Frames (n,) to train with, and frames of other specimens to test by.

    A fifth of the specimens, at least one, is drawn at random. For a single specimen the held-out
    part is the last fifth in time of the frames of each state: neighbours in time are too similar
    to test by.

    Args:
        dataset: dataset of at least two frames.
        seed: seed of the draw.
    """
    specimens = np.random.default_rng(seed).permutation(np.unique(dataset.specimen))
    if len(specimens) > 1:
        drawn = specimens[: max(1, round(HELD_OUT_SHARE * len(specimens)))]
        held_out = np.isin(dataset.specimen, drawn)
    else:
        held_out = _ends(dataset)
    return np.flatnonzero(~held_out), np.flatnonzero(held_out)


def _ends(dataset: Dataset) -> NDArray[np.bool_]:
    """Whether each frame (n,) is in the last fifth in time of its state."""
    late = np.zeros(len(dataset), dtype=np.bool_)
    for state in np.unique(dataset.state):
        frames = np.flatnonzero(dataset.state == state)
        order = np.lexsort((frames, dataset.time[frames], dataset.episode[frames]))
        late[frames[order][len(frames) - round(HELD_OUT_SHARE * len(frames)) :]] = True
    return late


def silent(stage: str, done: int, total: int) -> None:
    """Progress callback that does nothing."""


@old_names(epochs_of="count_epochs", shortened="shorten")
@dataclass(frozen=True, slots=True)
class NetworkSettings:
    """Hyper-parameters of one network, trained with Adam or with SOAP.

    Attributes:
        learning_rate: constant, or the highest of the one-cycle schedule.
        epochs: passes over the training frames.
        batch: frames per step.
        one_cycle: warm up to the learning rate and anneal to zero.
        noise: rms noise added to dV in every step, relative to the noise of the frames.
        fewest_steps: fewest steps of the whole training; where frames are few, there are more
            epochs.
        soap: whether SOAP trains it: dearer steps, of which a smooth network needs fewer.

    Example:
        >>> from eitskin.training import NetworkSettings
        >>> NetworkSettings(learning_rate=3e-3, epochs=100).batch
        64
    """

    learning_rate: float
    epochs: int
    batch: int = 64
    one_cycle: bool = True
    noise: float = 0.0
    fewest_steps: int = 0
    soap: bool = False

    def __post_init__(self) -> None:
        if not (self.learning_rate > 0 and self.epochs > 0 and self.batch > 0 and self.noise >= 0):
            raise ConfigurationError(
                "learning_rate, epochs and batch must be positive and noise not negative, got "
                f"{self}"
            )

    def count_epochs(self, count: int) -> int:
        """Number of epochs on `count` training frames."""
        return max(self.epochs, -(-self.fewest_steps // -(-count // self.batch)))

    def shorten(self, share: float) -> "NetworkSettings":
        """Settings with a share of the epochs and steps, at least one."""
        require_in_range("share", share, 0.0, 1.0)
        return replace(
            self,
            epochs=max(1, round(share * self.epochs)),
            fewest_steps=round(share * self.fewest_steps),
        )


@dataclass(frozen=True, slots=True)
class JointSettings:
    """Settings of the joint method's training.

    Attributes:
        response: response of the network of the touch response.
        proposals: proposals of the network that proposes positions; an epoch is a hundred steps on
            synthetic frames.
        angles: angles of the networks of the bend angle.
        drift: standard deviation after four hours of the factor common to all measurements: the gel
            dries and warms by a percent or two, the electronics drift by 0.2 %.
    """

    response: NetworkSettings = NetworkSettings(
        0.01, epochs=90, batch=512, fewest_steps=2000, soap=True
    )
    proposals: NetworkSettings = NetworkSettings(2e-3, epochs=40, batch=512)
    angles: NetworkSettings = NetworkSettings(3e-3, epochs=80, batch=256)
    drift: float = 0.02

    def __post_init__(self) -> None:
        """Check the drift."""
        if not 0.0 <= self.drift <= 1.0:
            raise ConfigurationError(f"drift must be from 0 to 1 in four hours, got {self.drift}")


@old_names(shortened="shorten")
@dataclass(frozen=True, slots=True)
class TrainingSettings:
    """Settings of a pipeline's training.

    Attributes:
        method: "joint", which fits a learned model of the sensor to each frame, "paper", the
            stages of the paper, one of `BASELINES`, or MODULE:CLASS, one of the user's own.
        joint: settings of the joint method.
        classifier: settings of the paper's classifier of states.
        postprocessor: settings of the paper's touch map network.
        bend_free_map: whether the classifier also uses a map that is insensitive to bending.
        compressed_maps: whether the classifier uses asinh of maps instead of standardised maps.
        bend_squares: whether the regression of the angle may also select squares of dV.
        weighted: whether images weigh each channel by its own noise, instead of one for all.
        mirrored: whether the touch map is also learned from mirror images of a symmetric sensor.
        seed: seed of the split, the initial weights, the order of frames and added noise.
        whole_specimens: whether a fifth of the specimens is held out, at least one, in place of
            `fractions`; see `hold_out`.
        whole_touches: whether frames with touches at the same positions stay together in a split of
            few specimens; not so in pipelines of version 0.2.
        options: hyper-parameters of a baseline or of a method of the user's own, by name, as JSON
            has them.

    Example:
        >>> from eitskin.training import TrainingSettings
        >>> TrainingSettings.preset("joint", 0).method
        'joint'
    """

    method: str = "paper"
    joint: JointSettings = JointSettings()
    classifier: NetworkSettings = NetworkSettings(1e-3, epochs=25, noise=0.5)
    postprocessor: NetworkSettings = NetworkSettings(
        3e-3, epochs=40, batch=32, noise=0.5, fewest_steps=800
    )
    bend_free_map: bool = True
    compressed_maps: bool = True
    bend_squares: bool = True
    weighted: bool = True
    mirrored: bool = True
    seed: int = 0
    whole_specimens: bool = False
    whole_touches: bool = True
    options: dict[str, Any] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        """Check the method, and options where it has none."""
        if self.method not in METHODS and ":" not in self.method:
            raise ConfigurationError(
                f"method must be one of {', '.join(METHODS)}, got '{self.method}'"
            )
        require_seed(self.seed)
        if self.options and self.method in ("joint", "paper"):
            raise ConfigurationError(
                f"the method '{self.method}' has no options, got {', '.join(self.options)}; its "
                "hyper-parameters are those of the settings"
            )

    @property
    def fractions(self) -> tuple[float, float, float]:
        """Shares of a dataset for training, validation and testing.

        The paper's method uses the paper's 60/20/20, the joint method 80/10/10.
        """
        return (0.8, 0.1, 0.1) if self.method == "joint" else (0.6, 0.2, 0.2)

    def split(self, dataset: Dataset) -> tuple[NDArray[np.int64], ...]:
        """Frames (n,) of the training, validation and test part of a dataset.

        With `whole_specimens` the validation part is the test part: losses on it select nothing.
        Touch positions are learned from the first of the single touches in time, by the option
        `share` (0.8), and tested on the others.
        """
        if self.method == POSITIONS:
            touches = single_touches(dataset)
            count = round(self.options.get("share", POSITION_SHARE) * len(touches))
            return touches[:count], touches[:0], touches[count:]
        if not self.whole_specimens:
            return dataset.split(self.fractions, self.seed, self.whole_touches)
        training_rows, held_out = hold_out(dataset, self.seed)
        return training_rows, held_out, held_out

    @classmethod
    def preset(cls, name: str, seed: int = 0) -> "TrainingSettings":
        """Settings by name: "joint", "quick", "paper", or one of `BASELINES`.

        "paper" follows the paper in every stage; `PaperMethod` lists its open choices. "quick" has
        the same stages, trained faster: images weigh each channel by its noise, the classifier
        also uses a map insensitive to bending, both compressed, the angle may be quadratic in dV,
        and touches are also learned from mirror images of a symmetric sensor.
        """
        if name not in PRESETS:
            raise ConfigurationError(f"preset must be one of {', '.join(PRESETS)}, got '{name}'")
        if name == "paper":
            classifier = NetworkSettings(1e-5, epochs=150, batch=64, one_cycle=False)
            closed: dict[str, Any] = dict.fromkeys(_OPEN_CHOICES, False)
            return cls(classifier=classifier, seed=seed, **closed)
        return cls("paper" if name == "quick" else name, seed=seed)

    def with_epochs(self, epochs: int) -> "TrainingSettings":
        """Settings with another number of epochs for all networks but the proposals.

        Methods with options get it as the option `epochs`.
        """
        if self.method not in ("joint", "paper"):
            return replace(self, options={**self.options, "epochs": epochs})
        return self._with_networks(
            lambda network: replace(network, epochs=epochs, fewest_steps=0), "response"
        )

    def shorten(self, share: float) -> "TrainingSettings":
        """Settings with a share of the epochs of all networks, at least one."""
        return self._with_networks(lambda network: network.shorten(share), "response", "proposals")

    def _with_networks(
        self, change: Callable[[NetworkSettings], NetworkSettings], *joint: str
    ) -> "TrainingSettings":
        """Settings with other networks of the paper's method, and of the joint one by name."""
        own: dict[str, Any] = {name: change(getattr(self.joint, name)) for name in joint}
        return replace(
            self,
            joint=replace(self.joint, **own),
            classifier=change(self.classifier),
            postprocessor=change(self.postprocessor),
        )


def single_touches(dataset: Dataset) -> NDArray[np.int64]:
    """Numbers of the frames with exactly one touch, in the order of time (n,)."""
    single_rows = np.flatnonzero(dataset.touch_count == 1)
    order = np.lexsort((single_rows, dataset.time[single_rows], dataset.episode[single_rows]))
    return single_rows[order]
