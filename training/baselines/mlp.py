"""Multilayer perceptrons for states, angle and touches."""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.extras import require
from eitskin.threads import one_torch_thread
from eitskin.training.baselines.table import Array, TableMethod
from eitskin.training.method.settings import NetworkSettings, Progress


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
        from torch.nn import Linear, ReLU, Sequential

        from eitskin.training.method.network_training import seeded_network, train_network

        widths = [features.shape[1], *[options.width] * options.layers]
        pairs = list(itertools.pairwise(widths))

        def layers() -> Sequential:
            hidden = [layer for a, b in pairs for layer in (Linear(a, b), ReLU())]
            return Sequential(*hidden, Linear(widths[-1], truth.shape[1]))

        network = seeded_network(layers, seed)
        inputs, wanted = (torch.as_tensor(a, dtype=torch.float32) for a in (features, truth))
        with one_torch_thread():  # networks this small are slower on several
            train_network(
                network,
                lambda chosen, _: (inputs[chosen], wanted[chosen]),
                torch.nn.functional.mse_loss,
                len(features),
                NetworkSettings(options.learning_rate, options.epochs),
                seed,
                lambda done, total: progress(f"{cls.KIND}: network", done, total),
            )
        return {name: value.numpy() for name, value in network.state_dict().items()}

    @staticmethod
    def apply(arrays: Mapping[str, NDArray[Any]], features: Array) -> Array:
        numbers = sorted({int(name.split(".")[0]) for name in arrays if name[0].isdigit()})
        values = features.astype(np.float32)
        for number in numbers:
            values = values @ arrays[f"{number}.weight"].T + arrays[f"{number}.bias"]
            if number != numbers[-1]:
                values = np.maximum(values, 0.0)
        return values.astype(float)
