"""Frames for the training of parts of the joint method, from changes in closed form."""

import numpy as np

from eitskin.training.joint.combinations import Combinations
from eitskin.training.joint.mirrored_frames import MirroredFrames


def made_up_frames(change, angle_deg, specimen, noise, *, features=0, clamp=np.nan, touches=None):
    """Frames of which every measurement is a combination, without mirror images.

    Args:
        change: of log V (n, C).
        angle_deg: of the bend (n,) [deg].
        specimen: number of the specimen (n,).
        noise: standard deviation of every change, or the covariance of a frame's (C, C).
        features: of the specimen (n, P), or the number of features, which are zero.
        clamp: properties of the clamp (n, 4), or (n, 5) with plates; unknown by default.
        touches: x [m], y [m] and force [N] (n, k, 3); none by default.
    """
    count, channels = change.shape
    covariance = noise * np.eye(channels) * noise if np.isscalar(noise) else noise
    return MirroredFrames(
        change,
        angle_deg,
        np.zeros((count, 0, 3)) if touches is None else touches,
        specimen,
        np.zeros(count, np.int64),
        np.ones_like(change),
        np.zeros((count, features)) if np.isscalar(features) else features,
        np.broadcast_to(clamp, (count, np.shape(clamp)[-1] if np.ndim(clamp) else 4)),
        Combinations(np.sqrt(np.diagonal(covariance))),
        1.0,
        covariance,
    )
