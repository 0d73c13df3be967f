"""Regressions table by table: ridge regression, multilayer perceptrons, randomised trees."""

from abc import abstractmethod
from collections import ChainMap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from eitskin.config import from_dict
from eitskin.datasets import UNKNOWN_STATE, Dataset, State
from eitskin.extras import require
from eitskin.geometry import ConfigurationError, DataError
from eitskin.threads import one_torch_thread
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.method.interface import Method
from eitskin.training.method.observations import MissingChannels, Observations
from eitskin.training.method.predictions import Predictions
from eitskin.training.method.settings import NetworkSettings, Progress, TrainingSettings
from eitskin.training.method.stored_fields import (
    GIVEN_FIELD,
    Arrays,
    StoredFields,
    arrays_with_prefix,
    field_arrays,
    prefix_arrays,
    restored_fields,
)
from eitskin.training.method.targets import STATE_NAMES, Targets, TrainingFrames, most_probable
from eitskin.training.paper.layers import Layer, Network

PARAMETERS = np.logspace(-6, 3, 37)  # of ridge regression, relative to the number of frames
LEAF = -1  # child of a node without any, in scikit-learn's trees
Array = NDArray[np.float64]
Rows = NDArray[np.intp]

MIN_FRAMES = 20  # frames of a table
SOFT = 3.0  # noises below which the direction of a difference fades
STATE, ANGLE, COUNT, TOUCH = "state", "angle", "count", "touch"


@dataclass(frozen=True, slots=True, eq=False)
class Features(StoredFields):
    """Features of a frame, each with mean 0 and standard deviation 1 over the training frames.

    They are dV from the static reference; the direction of dV from the dynamic reference, which a
    touch's force changes little; and the logarithms of the sizes of both, in units of the noise.

    Attributes:
        static, dynamic: imputation of bad channels of dV from either reference.
        noise: rms of dV over the channels in a frame of noise alone, dimensionless.
        mean, scale: moments of the raw features (F,).
    """

    static: MissingChannels
    dynamic: MissingChannels
    noise: float
    mean: Array
    scale: Array

    @classmethod
    def fit(cls, frames: TrainingFrames) -> "Features":
        """Features scaled to some frames."""
        seen, noise = frames.observations, max(frames.noise, 1e-9)
        static, dynamic = (MissingChannels.fit(dV, noise) for dV in (seen.static, seen.dynamic))
        raw = cls(static, dynamic, noise, np.zeros(1), np.ones(1))
        table = raw.apply(seen)
        scale = table.std(axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        return cls(static, dynamic, noise, table.mean(axis=0), scale)

    def apply(self, observations: Observations) -> Array:
        """Table of features (n, F)."""
        static = self.static.fill(observations.static)
        dynamic = self.dynamic.fill(observations.dynamic)
        floor = self.noise * np.sqrt(static.shape[1])
        sizes = [np.linalg.norm(dV, axis=1, keepdims=True) for dV in (static, dynamic)]
        direction = dynamic / np.hypot(sizes[1], SOFT * floor)
        logs = [np.log1p(size / floor) for size in sizes]
        table: Array = (np.hstack([static, direction, *logs]) - self.mean) / self.scale
        return table


@dataclass(frozen=True, slots=True, eq=False)
class TableMethod(Method):
    """A method that regresses state, angle, number and places of touches on `Features`.

    A derived class has a `KIND`, `OPTIONS` and the regression: `learn` and `apply`. Touches are
    those of the most probable number, in frames whose most probable state is touch. A number of
    touches with fewer than 20 training frames is not learned.

    Attributes:
        features: features of a frame.
        tasks: fitted arrays of each regression, by its name, and `mean` and `scale` of its targets.
        spec: sensor.
        states: states that are distinguished.
        counts: numbers of touches that are distinguished.
        radius: radius of the indenters [m].
    """

    OPTIONS: ClassVar[type[Any]]
    """Dataclass of the options."""

    features: Features
    tasks: Annotated[Mapping[str, Arrays], GIVEN_FIELD]
    spec: Annotated[InputSpec, GIVEN_FIELD]
    states: tuple[int, ...]
    counts: tuple[int, ...]
    radius: float

    @classmethod
    @abstractmethod
    def learn(
        cls, features: Array, truth: Array, options: Any, seed: int, progress: Progress
    ) -> Arrays:
        """Arrays of a regression of targets (m, K), standardised, on features (m, F)."""

    @staticmethod
    @abstractmethod
    def apply(arrays: Arrays, features: Array) -> Array:
        """Targets (n, K) of features (n, F)."""

    @classmethod
    def fit(cls, frames: TrainingFrames, settings: TrainingSettings, progress: Progress) -> Self:
        options = from_dict(cls.OPTIONS, settings.options, f"options of the method {cls.KIND}")
        features = Features.fit(frames)
        table, data = features.apply(frames.observations), frames.dataset
        tasks, models = list(_tasks(data, frames.targets)), {}
        for number, (name, rows, truth) in enumerate(tasks):
            progress(cls.KIND, number, len(tasks))
            mean, scale = truth.mean(axis=0), truth.std(axis=0)
            scale = np.where(scale > 0, scale, 1.0)
            targets = (truth - mean) / scale
            learned = cls.learn(table[rows], targets, options, settings.seed, progress)
            models[name] = {**learned, "mean": mean, "scale": scale}
        progress(cls.KIND, len(tasks), len(tasks))
        if not models:
            raise DataError(
                f"the method {cls.KIND} needs at least {MIN_FRAMES} frames of a kind, got "
                f"{len(frames)} in all; generate more"
            )
        counts = tuple(int(n.removeprefix(TOUCH)) for n in models if n.startswith(TOUCH))
        states = tuple(STATE_NAMES.index(name) for name in frames.targets.states)
        radius = float(np.nanmedian(data.touch_radius)) if counts else 0.0
        return cls(features, models, frames.spec, states, counts, radius)

    @property
    def targets(self) -> Targets:
        """Quantities that the tables had labels for."""
        touches, fewest = bool(self.counts), min(self.counts, default=0)
        force = touches and len(self.tasks[f"{TOUCH}{fewest}"]["mean"]) == 3 * fewest
        states = tuple(STATE_NAMES[state] for state in self.states)
        return Targets(states, ANGLE in self.tasks, touches, force)

    def predict(self, observations: Observations) -> Predictions:
        table = self.features.apply(observations)
        count, targets = len(table), self.targets
        probabilities = np.full((count, len(State)), np.nan)
        if self.states:
            positive = np.clip(self._values(STATE, table), 1e-6, None)
            probabilities[:, self.states] = positive / positive.sum(axis=1, keepdims=True)
        placed = np.full((count, max(self.counts, default=0), 3), np.nan)
        touched = np.flatnonzero(most_probable(probabilities) == State.TOUCH)
        if targets.touches and len(touched):
            numbers = np.full(len(touched), self.counts[0])
            if COUNT in self.tasks:
                likely = self._values(COUNT, table[touched]).argmax(axis=1)
                numbers = np.array(self.counts)[likely]
            for number in np.unique(numbers):
                rows = touched[numbers == number]
                values = self._values(f"{TOUCH}{number}", table[rows])
                values = values.reshape(len(rows), number, -1)
                placed[rows, :number, : values.shape[2]] = values
        return Predictions.from_arrays(
            count,
            self.spec,
            probabilities=probabilities if self.states else None,
            bend_angle_deg=self._values(ANGLE, table)[:, 0] if targets.angle else None,
            places=placed[..., :2] if targets.touches else None,
            force=placed[..., 2],
            radius=self.radius,
        )

    def _values(self, task: str, table: Array) -> Array:
        """Targets (n, K) of one regression, in their units."""
        arrays = self.tasks[task]
        values: Array = self.apply(arrays, table) * arrays["scale"] + arrays["mean"]
        return values

    def arrays(self) -> Arrays:
        tasks = (prefix_arrays(name, arrays) for name, arrays in self.tasks.items())
        return dict(ChainMap(field_arrays(self), *tasks))

    @classmethod
    def from_arrays(
        cls,
        arrays: Arrays,
        spec: InputSpec,
        settings: TrainingSettings,  # noqa: ARG003  the arrays say all
    ) -> Self:
        names = {name.partition(".")[0] for name in arrays if "." in name} - {"features"}
        tasks = {name: arrays_with_prefix(name, arrays) for name in names}
        return cls(**restored_fields(cls, arrays, tasks=tasks, spec=spec))


def _tasks(data: Dataset, targets: Targets) -> Iterator[tuple[str, Rows, Array]]:
    """Regressions that a dataset has at least `MIN_FRAMES` frames for.

    Yields:
        name: "state" and "count" are indicators of classes (regression on an indicator matrix,
            Hastie et al. 2009, section 4.2), "angle" is [deg], and "touch2" x and y [m] and, where
            known, force [N] of two touches, in the order of x.
        rows: frames (m,) that have labels.
        truth: (m, K).
    """
    if targets.states:
        rows = np.flatnonzero(data.state != UNKNOWN_STATE)
        classes = [STATE_NAMES.index(name) for name in targets.states]
        yield STATE, rows, (data.state[rows, None] == classes).astype(float)
    angle = data.bend_angle_deg.astype(float)
    rows = np.flatnonzero(np.isfinite(angle))
    if targets.angle and len(rows) >= MIN_FRAMES:
        yield ANGLE, rows, angle[rows, None]
    if "touch" not in targets.states or not targets.touches:
        return
    columns = [data.touch_x, data.touch_y, *([data.touch_force] if targets.force else [])]
    values = np.stack(columns, axis=2).astype(float)
    known = np.isfinite(values).all(axis=2).sum(axis=1)
    known = np.where(known == data.touch_count, known, 0)
    counts = [int(n) for n in np.unique(known[known > 0]) if np.sum(known == n) >= MIN_FRAMES]
    if len(counts) > 1:
        rows = np.flatnonzero(np.isin(known, counts))
        yield COUNT, rows, (known[rows, None] == counts).astype(float)
    for number in counts:
        rows = np.flatnonzero(known == number)
        order = np.argsort(values[rows, :, 0], axis=1)[:, :number]  # NaN last
        ordered = np.take_along_axis(values[rows], order[..., None], axis=1)
        yield f"{TOUCH}{number}", rows, ordered.reshape(len(rows), -1)


@dataclass(frozen=True, slots=True)
class RidgeOptions:
    """Options of ridge regression.

    Attributes:
        squares: whether the squares of the features are features, too.
    """

    squares: bool = True


class RidgeMethod(TableMethod):
    """Ridge regression; generalised cross-validation chooses the parameter of each table.

    w = (X^T X + lambda I)^-1 X^T y, with the lambda of the least
    |y - X w|^2 / (m - trace X (X^T X + lambda I)^-1 X^T)^2 (Golub, Heath and Wahba 1979).
    """

    KIND: ClassVar[str] = "ridge"
    OPTIONS: ClassVar[type[Any]] = RidgeOptions
    __slots__ = ()

    @classmethod
    def learn(
        cls,
        features: Array,
        truth: Array,
        options: RidgeOptions,
        seed: int,  # noqa: ARG003  nothing is random
        progress: Progress,  # noqa: ARG003  done at once
    ) -> dict[str, Array]:
        table = np.hstack([features, features**2]) if options.squares else features
        middle = table.mean(axis=0)
        U, s, Vt = np.linalg.svd(table - middle, full_matrices=False)
        projected, residual = U.T @ truth, np.sum(truth**2)
        errors, m = [], len(table)
        for parameter in m * PARAMETERS:
            shrinkage = s**2 / (s**2 + parameter)
            misfit = residual - np.sum((1.0 - (1.0 - shrinkage[:, None]) ** 2) * projected**2)
            errors.append(misfit / (m - shrinkage.sum()) ** 2)
        chosen = m * PARAMETERS[int(np.argmin(errors))]
        weights: Array = Vt.T @ ((s / (s**2 + chosen))[:, None] * projected)
        return {"weights": weights, "middle": middle}

    @staticmethod
    def apply(arrays: Mapping[str, NDArray[Any]], features: Array) -> Array:
        weights, middle = arrays["weights"], arrays["middle"]
        squared = len(weights) > features.shape[1]
        table = np.hstack([features, features**2]) if squared else features
        values: Array = (table - middle) @ weights
        return values


@dataclass(frozen=True, slots=True)
class MlpOptions:
    """Options of the networks.

    Attributes:
        width: units of a hidden layer.
        layers: hidden layers.
        epochs: passes over the frames.
        learning_rate: highest of the one-cycle schedule.
    """

    width: int = 128
    layers: int = 2
    epochs: int = 150
    learning_rate: float = 3e-3

    def __post_init__(self) -> None:
        if not (0 < self.width <= 4096 and 0 < self.layers <= 10):
            raise ConfigurationError(
                f"expected a width of 1 to 4096 and 1 to 10 layers, got {self.width} and "
                f"{self.layers}"
            )


class MlpMethod(TableMethod):
    """One network with rectified linear units for each table, trained by Adam on squared errors."""

    KIND: ClassVar[str] = "mlp"
    OPTIONS: ClassVar[type[Any]] = MlpOptions
    __slots__ = ()

    @classmethod
    def learn(
        cls, features: Array, truth: Array, options: MlpOptions, seed: int, progress: Progress
    ) -> dict[str, NDArray[np.float32]]:
        require("torch", "training")
        import torch

        from eitskin.training.method.network_training import (
            as_tensor,
            dense_layers,
            seeded_network,
            train_network,
        )

        sizes = [features.shape[1], *[options.width] * options.layers, truth.shape[1]]
        network = seeded_network(lambda: dense_layers(sizes, torch.nn.ReLU), seed)
        inputs, targets = as_tensor(features), as_tensor(truth)
        with one_torch_thread():  # networks this small are slower on several
            train_network(
                network,
                lambda chosen, _: (inputs[chosen], targets[chosen]),
                torch.nn.functional.mse_loss,
                len(features),
                NetworkSettings(options.learning_rate, options.epochs),
                seed,
                lambda done, total: progress(f"{cls.KIND}: network", done, total),
            )
        return {name: value.numpy() for name, value in network.state_dict().items()}

    @staticmethod
    def apply(arrays: Mapping[str, NDArray[Any]], features: Array) -> Array:
        last = sum(name.endswith("weight") for name in arrays) - 1
        layers = []
        for number in range(last + 1):
            outputs, inputs = arrays[f"{2 * number}.weight"].shape
            layers.append(Layer("dense", inputs, outputs, rectified=number < last))
        return Network.from_arrays(layers, arrays).logits(features)


@dataclass(frozen=True, slots=True)
class TreeOptions:
    """Options of the trees.

    Attributes:
        trees: number of them.
        leaf: least number of frames in a leaf.
    """

    trees: int = 100
    leaf: int = 2


class ExtraTreesMethod(TableMethod):
    """Mean of extremely randomised trees (Geurts et al. 2006), one forest for each table.

    scikit-learn grows the trees; they are kept as arrays of their nodes and need it no longer.
    """

    KIND: ClassVar[str] = "extra-trees"
    OPTIONS: ClassVar[type[Any]] = TreeOptions
    __slots__ = ()

    @classmethod
    def learn(
        cls,
        features: Array,
        truth: Array,
        options: TreeOptions,
        seed: int,
        progress: Progress,  # noqa: ARG003  scikit-learn shows none
    ) -> dict[str, NDArray[Any]]:
        require("sklearn", "training")
        from sklearn.ensemble import ExtraTreesRegressor

        forest = ExtraTreesRegressor(
            options.trees, min_samples_leaf=options.leaf, random_state=seed
        ).fit(features, truth if truth.shape[1] > 1 else truth[:, 0])
        trees = [estimator.tree_ for estimator in forest.estimators_]
        first = np.cumsum([0, *(tree.node_count for tree in trees)])
        children = (
            [
                np.where(side == LEAF, LEAF, side + start)
                for side, start in zip((getattr(t, name) for t in trees), first[:-1], strict=True)
            ]
            for name in ("children_left", "children_right")
        )
        left_children, right_children = (np.concatenate(side).astype(np.int32) for side in children)
        return {
            "roots": first[:-1].astype(np.int32),
            "left": left_children,
            "right": right_children,
            "feature": np.concatenate([tree.feature for tree in trees]).astype(np.int32),
            "threshold": np.concatenate([tree.threshold for tree in trees]),
            "value": np.concatenate([tree.value[:, :, 0] for tree in trees]).astype(np.float32),
        }

    @staticmethod
    def apply(arrays: Mapping[str, NDArray[Any]], features: Array) -> Array:
        inputs = features.astype(np.float32)  # as scikit-learn compares them
        node = np.repeat(arrays["roots"][None], len(inputs), axis=0)
        rows = np.arange(len(inputs))[:, None]
        while (inner := arrays["left"][node] != LEAF).any():
            low = inputs[rows, arrays["feature"][node]] <= arrays["threshold"][node]
            child = np.where(low, arrays["left"][node], arrays["right"][node])
            node = np.where(inner, child, node)
        values: Array = arrays["value"][node].astype(float).mean(axis=1)
        return values
