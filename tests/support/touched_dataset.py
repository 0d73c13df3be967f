"""Datasets of made-up frames, with touches as lists of places."""

import numpy as np

from eitskin.datasets import Dataset


def touched_dataset(values, flat, places=(), **known):
    """Dataset of frames (n, C) of one sensor, which is `flat` (C,) untouched.

    `places` has x and y [m] of the touches of each frame; other labels are those of a dataset.
    """
    xy = np.full((2, len(values), 4), np.nan)
    for row, each in enumerate(places):
        touches = np.reshape(each, (-1, 2))
        xy[:, row, : len(touches)] = touches.T
    labels = {"specimen": np.zeros(len(values)), "touch_x": xy[0], "touch_y": xy[1]}
    return Dataset.from_arrays(np.asarray(values), flat, **labels | known)
