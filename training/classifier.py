"""Idle, touched or bent: the paper's encoder-decoder network on maps from the flat reference."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.geometry.optional import require
from eitskin.training.settings import NetworkSettings, Progress, silent

if TYPE_CHECKING:
    from eitskin.training.networks import StateNetwork


class Classifier:
    """Probabilities of the three states of `eitskin.datasets.State`.

    Attributes:
        network: trained, in evaluation mode.
        embedding: linear, from dV to the maps that the network sees, (maps, pixels, measurements).
        shape: of a map.
    """

    def __init__(
        self, network: "StateNetwork", embedding: NDArray[np.float64], shape: tuple[int, int]
    ) -> None:
        """Wrap a trained network."""
        self.network = network
        self.embedding = embedding
        self.shape = shape

    @classmethod
    def fit(
        cls,
        difference: ArrayLike,
        state: ArrayLike,
        embedding: ArrayLike,
        shape: tuple[int, int],
        settings: NetworkSettings,
        noise: float = 0.0,
        seed: int = 0,
        progress: Progress = silent,
    ) -> "Classifier":
        """Train with sparse categorical cross-entropy and Adam.

        Args:
            difference: dV from the static reference (n, measurements).
            state: (n,) `State` values.
            embedding: from dV to maps (maps, pixels, measurements), in any units; not trained.
            shape: of a map.
            settings: of the training.
            noise: rms noise that dV already has; `settings.noise` counts in it.
            seed: of initial weights, order and added noise.
            progress: told of every epoch.
        """
        require("torch", "training")
        import torch

        from eitskin.training.networks import StateNetwork, noisy_maps, seeded, train

        scaled = _of_unit_spread(np.asarray(embedding, dtype=float), np.asarray(difference))
        network = seeded(lambda: StateNetwork(shape, len(scaled)), seed)
        maps = noisy_maps(difference, scaled, shape, settings.noise * noise)
        targets = torch.as_tensor(np.asarray(state, dtype=np.int64))
        train(
            network,
            lambda chosen, generator: (maps(chosen, generator), targets[chosen]),
            torch.nn.functional.cross_entropy,
            len(targets),
            settings,
            seed,
            lambda done, total: progress("state classifier", done, total),
        )
        return cls(network, scaled, shape)

    def apply(self, difference: ArrayLike) -> NDArray[np.float64]:
        """Probabilities (n, 3) of idle, touch and bend for dV (n, measurements)."""
        from eitskin.training.networks import evaluate

        dV = np.asarray(difference, dtype=float)
        maps = np.stack([dV @ layer.T for layer in self.embedding], axis=1)
        logits = evaluate(self.network, maps.reshape(len(dV), -1, *self.shape))
        odds = np.exp(logits - logits.max(axis=1, keepdims=True))
        probabilities: NDArray[np.float64] = odds / odds.sum(axis=1, keepdims=True)
        return probabilities

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """What `from_arrays` needs to make this stage again."""
        from eitskin.training.networks import weights_of

        return {"embedding": self.embedding, **weights_of(self.network)}

    @classmethod
    def from_arrays(
        cls, arrays: dict[str, NDArray[np.generic]], shape: tuple[int, int]
    ) -> "Classifier":
        """The stage that `arrays` came from, for maps of `shape`."""
        require("torch", "training")
        from eitskin.training.networks import StateNetwork, with_weights

        embedding = arrays["embedding"].astype(float)
        return cls(with_weights(StateNetwork(shape, len(embedding)), arrays), embedding, shape)


def _of_unit_spread(
    embedding: NDArray[np.float64], difference: NDArray[np.floating]
) -> NDArray[np.float64]:
    """The embedding with each map divided by its standard deviation over the training frames."""
    spread = np.array([np.std(difference @ layer.T) for layer in embedding])
    scaled: NDArray[np.float64] = embedding / np.where(spread > 0, spread, 1.0)[:, None, None]
    return scaled
