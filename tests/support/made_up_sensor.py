"""Frames of a sensor that is made up: channels that answer bends in line, and touches nearby."""

import numpy as np

from eitskin.datasets import Dataset, State
from eitskin.geometry import SensorDesign
from eitskin.simulator import Protocol

FLAT = np.linspace(400.0, 820.0, 28)
SIZE = np.array([0.150, 0.060])
NOISE = 1e-5  # relative, of one frame

_rng = np.random.default_rng(7)
OWN = _rng.uniform(0, 1, (28, 2)) * SIZE  # place that each channel feels most
BEND = _rng.normal(size=28) * 1e-4  # relative change per degree


def touch_change(places, force=1.0):
    """Relative change (28,) by touches at places (k, 2) [m]; NaN for none."""
    away = np.linalg.norm(np.asarray(places)[:, None] - OWN, axis=2)
    return np.nansum(-5e-3 * force * np.exp(-((away / 0.04) ** 2)), axis=0)


def frames(n=240, seed=0, most=2, specimens=6):
    """Dataset of frames idle, touched by one or more (half of them bent) and bent, in turn."""
    rng = np.random.default_rng(seed)
    order = np.arange(n)
    state = order % 3
    bent = (state == State.BEND) | ((state == State.TOUCH) & (rng.random(n) < 0.5))
    angle = np.where(bent, rng.uniform(8, 50, n) * rng.choice([-1, 1], n), 0.0)
    counts = np.where(state == State.TOUCH, 1 + (order // 3) % most, 0)
    places = np.full((n, 4, 2), np.nan)
    force = np.full((n, 4), np.nan)
    for row, count in enumerate(counts):
        places[row, :count] = rng.uniform(0.15, 0.85, (count, 2)) * SIZE
        places[row, :count, 0] = (np.arange(count) + rng.uniform(0.2, 0.8, count)) * 0.15 / count
        force[row, :count] = 10.0
    bends = angle[:, None] * BEND
    touches = np.array([touch_change(each) for each in places])

    def noisy(change):
        return FLAT * (1 + change + rng.normal(size=change.shape) * NOISE)

    return Dataset.from_arrays(
        noisy(bends + touches),
        np.tile(FLAT, (specimens, 1)),
        touch_reference=noisy(bends),
        specimen=order // (3 * most) % specimens,
        state=state,
        bend_angle_deg=angle,
        touch_x=places[..., 0],
        touch_y=places[..., 1],
        touch_radius=np.where(np.isfinite(force), 0.0075, np.nan),
        touch_force=force,
        protocol=Protocol.pairwise(8),
        source="simulated",
        design=SensorDesign.reference(),
    )
