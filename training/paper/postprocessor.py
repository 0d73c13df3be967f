"""Convolutional post-processor, from a blurred reconstruction to the touch map."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.errors import DataError
from eitskin.extras import require
from eitskin.training.method.learning_curve import LearningCurve
from eitskin.training.method.settings import NetworkSettings, Progress, silent
from eitskin.training.paper.layers import coordinates, layer_arrays, logits_of, touch_map_layers
from eitskin.training.paper.reconstruction import Reconstruction


class PostProcessor:
    """Convolutional network for the probability of each pixel to lie under an indenter.

    Attributes:
        weights: trained weights and batch statistics of the network, by name.
        layers: of the network with these weights.
        scale: divisor of the reconstructions before the network, their standard deviation over
            the training frames.
        history: losses in training.
    """

    def __init__(
        self,
        weights: Mapping[str, NDArray[Any]],
        scale: float,
        history: LearningCurve | None = None,
    ) -> None:
        """A post-processor with a trained network; raises DataError for weights of another one."""
        self.weights = weights
        self.layers = touch_map_layers(weights)
        self.scale = scale
        self.history = history or LearningCurve()

    @classmethod
    def fit(
        cls,
        difference: ArrayLike,
        touch_map: ArrayLike,
        reconstruction: Reconstruction,
        settings: NetworkSettings,
        noise: ArrayLike = 0.0,
        seed: int = 0,
        progress: Progress = silent,
        validation: tuple[ArrayLike, ArrayLike] | None = None,
        flips: Sequence[tuple[bool, bool]] = ((False, False),),
    ) -> "PostProcessor":
        """Training with binary cross-entropy per pixel and Adam.

        Args:
            difference: dV from the dynamic reference (n, measurements), dimensionless.
            touch_map: true maps (n, rows, columns), 1 under an indenter and 0 elsewhere.
            reconstruction: linear layer before the network; not trained.
            settings: of the training.
            noise: rms noise of dV, of all or of each channel, the unit of `settings.noise`.
            seed: of initial weights, order and added noise.
            progress: called after every epoch.
            validation: dV and touch maps of other frames, whose loss is recorded after every
                epoch.
            flips: mirror images of each frame, of which one is drawn whenever it is used: whether
                x and whether y is reversed.
        """
        require("torch", "training")
        import torch

        from eitskin.training.method.network_training import Samples, seeded_network, train_network
        from eitskin.training.paper.networks import (
            TouchMapNetwork,
            mirrored,
            noisy_maps,
            weights_of,
        )

        scale = float(np.std(reconstruction.apply(difference))) or 1.0
        network = seeded_network(lambda: TouchMapNetwork(reconstruction.shape), seed)
        layer = reconstruction.matrix[None] / scale

        def samples(dV: ArrayLike, truth: ArrayLike, rms: ArrayLike) -> Samples:
            maps = noisy_maps(dV, layer, reconstruction.shape, rms)
            targets = torch.as_tensor(np.asarray(truth, dtype=np.float32))[:, None]
            return Samples(
                lambda chosen, generator: (maps(chosen, generator), targets[chosen]), len(targets)
            )

        fitted = samples(difference, touch_map, settings.noise * np.asarray(noise))
        history = train_network(
            network,
            mirrored(fitted.batch, flips),
            torch.nn.functional.binary_cross_entropy_with_logits,
            fitted.count,
            settings,
            seed,
            lambda done, total: progress("touch map", done, total),
            None if validation is None else samples(*validation, 0.0),
        )
        return cls(weights_of(network), scale, history)

    def apply(self, maps: ArrayLike) -> NDArray[np.float32]:
        """Touch maps, 0 to 1, from reconstructions, both (n, rows, columns)."""
        pictures = np.asarray(maps, dtype=np.float32)[:, None] / np.float32(self.scale)
        place = np.broadcast_to(
            coordinates(pictures.shape[2:]), (len(pictures), 2, *pictures.shape[2:])
        )
        logits = logits_of(self.layers, np.concatenate([pictures, place], axis=1))[:, 0]
        touch_map: NDArray[np.float32] = (0.5 * (1 + np.tanh(0.5 * logits))).astype(np.float32)
        return touch_map

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """Trained arrays of the stage, as `from_arrays` takes them."""
        return {
            "scale": np.array(self.scale),
            **self.history.arrays(),
            **self.weights,
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[np.generic]]) -> "PostProcessor":
        """The stage with the trained `arrays`; raises DataError for those of another network."""
        if "scale" not in arrays:
            raise DataError(
                "expected the scale of a saved post-processor, which is missing; save the pipeline "
                "again"
            )
        history = LearningCurve.from_arrays(arrays)
        return cls(layer_arrays(arrays), float(arrays["scale"].astype(float)), history)
