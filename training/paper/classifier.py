"""Classifier of idle, touch and bend: the paper's encoder-decoder network."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.datasets.store.state import State
from eitskin.extras import require
from eitskin.training.method.learning_curve import LearningCurve
from eitskin.training.method.settings import NetworkSettings, Progress, silent
from eitskin.training.paper.layers import layer_arrays, logits_of, state_layers


class Classifier:
    """Classifier of the three states of `eitskin.datasets.State` from reconstructed maps.

    The paper does not say how maps are scaled. Here the maps are divided by their standard
    deviation over the training frames, or compressed: a touch may be three times the noise and a
    bend a hundred times, so the input is then asinh of the maps in units of their noise, linear
    for small values and logarithmic for large ones.

    Attributes:
        weights: trained weights and batch statistics of the network, by name.
        layers: of the network with these weights.
        embedding: linear map from dV to scaled maps, (maps, pixels, measurements).
        shape: rows and columns of a map.
        compress: whether asinh is taken of the maps.
        history: losses in training.
        states: that were trained for; the others have no probability.
    """

    def __init__(
        self,
        weights: Mapping[str, NDArray[Any]],
        embedding: NDArray[np.float64],
        shape: tuple[int, int],
        compress: bool,
        history: LearningCurve | None = None,
        states: Sequence[State] = tuple(State),
    ) -> None:
        """A classifier with a trained network; raises DataError for weights of another one."""
        self.weights = weights
        self.layers = state_layers(weights, shape, len(embedding))
        self.embedding = embedding
        self.shape = shape
        self.compress = compress
        self.history = history or LearningCurve()
        self.states = tuple(states)

    @classmethod
    def fit(
        cls,
        difference: ArrayLike,
        state: ArrayLike,
        embedding: ArrayLike,
        shape: tuple[int, int],
        settings: NetworkSettings,
        noise: ArrayLike = 0.0,
        seed: int = 0,
        progress: Progress = silent,
        validation: tuple[ArrayLike, ArrayLike] | None = None,
        *,
        compress: bool = True,
    ) -> "Classifier":
        """Training with cross-entropy and Adam.

        Args:
            difference: dV from the static reference (n, measurements), dimensionless.
            state: `State` values (n,).
            embedding: linear map from dV to maps (maps, pixels, measurements) in any units; not
                trained.
            shape: rows and columns of a map.
            settings: of the training.
            noise: rms noise of dV, of all or of each channel, the unit of `settings.noise`.
            seed: of initial weights, order and added noise.
            progress: called after every epoch.
            validation: dV and states of other frames, whose loss is recorded after every epoch.
            compress: whether asinh is taken of the maps.
        """
        require("torch", "training")
        import torch

        from eitskin.training.method.network_training import Samples, seeded_network, train_network
        from eitskin.training.paper.networks import StateNetwork, noisy_maps, weights_of

        states = np.asarray(state, dtype=np.int64)
        scaled = _scaled(
            np.asarray(embedding, dtype=float),
            np.asarray(difference),
            states == State.IDLE if compress else None,
        )
        scale = torch.asinh if compress else torch.nn.Identity()
        network = seeded_network(lambda: StateNetwork(shape, len(scaled)), seed)

        def samples(dV: ArrayLike, truth: ArrayLike, rms: ArrayLike) -> Samples:
            maps = noisy_maps(dV, scaled, shape, rms)
            targets = torch.as_tensor(np.asarray(truth, dtype=np.int64))
            return Samples(
                lambda chosen, generator: (scale(maps(chosen, generator)), targets[chosen]),
                len(targets),
            )

        fitted = samples(difference, states, settings.noise * np.asarray(noise))
        history = train_network(
            network,
            fitted.batch,
            torch.nn.functional.cross_entropy,
            fitted.count,
            settings,
            seed,
            lambda done, total: progress("state classifier", done, total),
            None if validation is None else samples(*validation, 0.0),
        )
        present = [state for state in State if np.any(states == state)]
        return cls(weights_of(network), scaled, shape, compress, history, present)

    def apply(self, difference: ArrayLike) -> NDArray[np.float64]:
        """Probabilities (n, 3) of idle, touch and bend for dV (n, measurements).

        NaN for a state that was not trained for.
        """
        dV = np.asarray(difference, dtype=float)
        maps = np.stack([dV @ layer.T for layer in self.embedding], axis=1)
        if self.compress:
            maps = np.arcsinh(maps)
        logits = logits_of(self.layers, maps.reshape(len(dV), -1, *self.shape))
        known = logits[:, self.states]
        odds = np.exp(known - known.max(axis=1, keepdims=True))
        probabilities = np.full(logits.shape, np.nan)
        probabilities[:, self.states] = odds / odds.sum(axis=1, keepdims=True)
        return probabilities

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """Trained arrays of the stage, as `from_arrays` takes them."""
        return {
            "embedding": self.embedding,
            "compress": np.array(self.compress),
            "states": np.array(self.states, dtype=np.int64),
            **self.history.arrays(),
            **self.weights,
        }

    @classmethod
    def from_arrays(
        cls, arrays: dict[str, NDArray[np.generic]], shape: tuple[int, int]
    ) -> "Classifier":
        """The stage with the trained `arrays`, for maps of `shape`.

        Raises DataError for arrays of another network.
        """
        embedding = arrays["embedding"].astype(float)
        compress = bool(arrays["compress"])
        states = [State(int(state)) for state in arrays.get("states", np.arange(len(State)))]
        history = LearningCurve.from_arrays(arrays)
        return cls(layer_arrays(arrays), embedding, shape, compress, history, states)


def _scaled(
    embedding: NDArray[np.float64], difference: NDArray[np.floating], idle: NDArray[np.bool_] | None
) -> NDArray[np.float64]:
    """The embedding with each map divided by its standard deviation over the training frames.

    With a mask of `idle` frames, the divisor is twice the standard deviation over the idle frames:
    the noise, and some of its tail.
    """
    scaled = np.empty_like(embedding)
    for i, layer in enumerate(embedding):
        maps = difference @ layer.T
        noise = 0.0 if idle is None or not idle.any() else 2.0 * float(np.std(maps[idle]))
        scaled[i] = layer / (noise or float(np.std(maps)) or 1.0)
    return scaled
