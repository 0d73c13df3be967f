"""Regressions of the baselines: ridge regression, multilayer perceptrons, randomised trees."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from eitskin.extras import require
from eitskin.geometry import ConfigurationError
from eitskin.threads import one_torch_thread
from eitskin.training.baselines.table import Array, TableMethod
from eitskin.training.method.settings import NetworkSettings, Progress
from eitskin.training.paper.layers import Layer, Network

PARAMETERS = np.logspace(-6, 3, 37)  # of ridge regression, relative to the number of frames
LEAF = -1  # child of a node without any, in scikit-learn's trees


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
        return Network.from_arrays("network", layers, arrays).logits(features)


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
