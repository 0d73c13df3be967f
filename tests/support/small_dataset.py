"""A small dataset with something in every array, and how to compare two."""

import numpy as np

from eitskin.datasets import Dataset, State
from eitskin.datasets.store.schema import FIELDS
from eitskin.geometry import SensorDesign
from eitskin.simulator import Protocol


def make(n=40, specimens=2, **changes):
    """A dataset with something in every array."""
    rng = np.random.default_rng(1)
    complex_values = rng.normal(500, 50, (n, 28)) + 1j * rng.normal(0, 5, (n, 28))
    touches = np.full((4, n, 4), np.nan)
    touches[:, ::2, 0] = np.array([0.05, 0.02, 10.0, 0.0075])[:, None]
    known = {
        "touch_reference": complex_values * 1.01,
        "specimen": np.arange(n) % specimens,
        "state": np.where(np.arange(n) % 2, State.BEND, State.TOUCH),
        "bend_angle_deg": rng.uniform(-20, 50, n),
        "touch_x": touches[0],
        "touch_y": touches[1],
        "touch_force": touches[2],
        "touch_radius": touches[3],
        "touch_depth": 0.1 * touches[3],
        "clamp_span": np.full(n, 0.04),
        "clamp_offset": np.full(n, 0.008),
        "clamp_faces": np.full(n, 2.0),
        "clamp_stiffness": np.full(n, 1.4),
        "support_gap": np.full(n, 0.04),
        "time": np.arange(n) * 0.1,
        "status": rng.integers(0, 64, (n, 28)),
        "episode": np.arange(n) // 10,
        "protocol": Protocol.pairwise(8),
        "frequency": 50e3,
        "source": "simulated",
        "recipe": 'name = "made for a test"\n',
        "seed": 7,
        "design": SensorDesign.reference(),
    }
    return Dataset.from_arrays(complex_values, complex_values[:specimens], **known | changes)


def assert_same(a, b):
    for field in FIELDS:
        first, second = getattr(a, field.name), getattr(b, field.name)
        assert first.dtype == second.dtype == field.dtype
        assert np.array_equal(first, second, equal_nan=field.dtype.kind in "fc"), field.name
    for name in ("protocol", "frequency", "source", "recipe", "seed", "design", "quantity"):
        assert getattr(a, name) == getattr(b, name)
