"""The reference sensor to first order: fast enough to make a training set in a test."""

from functools import lru_cache

import numpy as np
from touched_dataset import touched_dataset

from eitskin.datasets import State
from eitskin.geometry import SensorDesign
from eitskin.simulator import ForwardModel, Protocol

NOISE = 1e-5  # relative, of one frame; low, so that few and brief lessons suffice
X, Y = np.meshgrid((np.arange(80) + 0.5) * 0.150 / 80, (np.arange(32) + 0.5) * 0.060 / 32)


class LinearSensor:
    """Frames of one sensor, of its sensitivity alone."""

    def __init__(self):
        model = ForwardModel(SensorDesign.reference(), resolution="fast")
        self.protocol = Protocol.pairwise(8)
        self.flat = self.protocol.measure(model.impedance())
        J = model.sensitivity(self.protocol, pixels=(32, 80)) / self.flat[:, None]
        self.J = J

    def impedance(self, angle_deg=0.0, place=None, rng=None):
        """One frame [ohm], noisy where `rng` is given."""
        change = np.where(np.abs(X - 0.075) < 0.020, -1.5e-3 * angle_deg, 0.0)
        if place is not None:
            change = change - 0.3 * (np.hypot(X - place[0], Y - place[1]) < 0.0075)
        dV = self.J @ change.ravel()
        noise = 0 if rng is None else rng.normal(size=28) * NOISE
        return (self.flat * (1 + dV + noise)).astype(complex)

    def dataset(self, n=240):
        """Frames idle, touched (half of them while bent) and bent in turn, one touch at most."""
        rng = np.random.default_rng(0)
        state = np.arange(n) % 3
        bent = (state == State.BEND) | ((state == State.TOUCH) & (np.arange(n) % 2 == 0))
        angle = np.where(bent, rng.uniform(5, 50, n) * rng.choice([-1, 1], n), 0.0)
        places = rng.uniform([0.02, 0.012], [0.13, 0.048], size=(n, 2))
        touched = state == State.TOUCH
        frames = [
            self.impedance(angle[i], places[i] if touched[i] else None, rng) for i in range(n)
        ]
        return touched_dataset(
            frames,
            self.flat,
            [places[i : i + touched[i]] for i in range(n)],
            touch_reference=np.array([self.impedance(a, None, rng) for a in angle]),
            state=state,
            bend_angle_deg=angle,
            touch_radius=np.where(touched[:, None] & (np.arange(4) == 0), 0.0075, np.nan),
            protocol=self.protocol,
            source="simulated",
            design=SensorDesign.reference(),
        )


@lru_cache(maxsize=1)
def linear_sensor():
    """One for all who ask: its sensitivity takes seconds."""
    return LinearSensor()
