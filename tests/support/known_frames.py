"""Known frames as arrays: changes of log V in frames of known angles and touches."""

import numpy as np

from eitskin.simulator import Frame
from eitskin.training import Observations
from eitskin.training.method.known_frames import KnownFrames

from smooth_sensor import FLAT, LAYOUT, PROTOCOL


def known_frames(flat, flat_frames, change, angle_deg, *, touches=None, before=None, age=0.0):
    """Frames with changes of log V from the flat sensor (n, C), at angles (n,) [deg].

    Touches are tables (n, k, 3), none when omitted; `before` is the change of log V of the
    noise-free frames before the touches (n, C), from the flat sensor; zero when omitted.
    """
    count = len(change)
    before = np.zeros_like(change) if before is None else before
    angles = np.array(angle_deg, dtype=float)
    observations = Observations(
        np.expm1(change),
        np.expm1(change - before),
        np.tile(flat, (count, 1)),
        np.ones(count),
        np.full(count, float(flat_frames)),
        np.full(count, np.inf),
        np.full(count, float(age)),
        np.zeros(count),
    )
    reference = np.where(np.any(before, axis=1), angles, 0.0)
    touches = np.full((count, 1, 3), np.nan) if touches is None else touches
    return KnownFrames(observations, angles, reference, touches, np.ones(count, dtype=bool))


def known_by_levels(labels, levels):
    """Frames whose log V is this much above that of the flat sensor, half a second apart."""
    frames = [Frame(FLAT * np.exp(z) + 0j, PROTOCOL, 0.5 * i) for i, z in enumerate(levels)]
    return KnownFrames.from_frames(frames, labels, LAYOUT)
