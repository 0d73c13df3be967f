"""Toy skins: channels that answer touches in closed form, to test what learns their places."""

import numpy as np

OWN = 0.05 * np.stack([np.cos(np.arange(8) * np.pi / 4), np.sin(np.arange(8) * np.pi / 4)], axis=1)
NOISE = 2e-5


def toy_presses(count=60, seed=0, noise=NOISE, power=1.5):
    """Ratios (n, 8), places (n, 2) [m] and depths (n,) [m]; each channel feels its own region."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-0.05, 0.05, size=(count, 2))
    depth = rng.uniform(0.005, 0.015, size=count)
    distance = np.linalg.norm(places[:, None] - OWN, axis=2)
    change = 0.02 * ((depth / 0.01) ** power)[:, None] * np.exp(-((distance / 0.04) ** 2))
    return np.exp(change + rng.normal(size=change.shape) * noise), places, depth
