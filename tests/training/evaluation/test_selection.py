"""Warnings about what a training left out."""

import dataclasses
from types import SimpleNamespace

import numpy as np

from eitskin.datasets.store.manifest import Names
from eitskin.training.evaluation.selection import _left_out

from small_dataset import make

OWN = Names({2: "cast 7"})


def left_out(specimens, names=OWN):
    """Warnings where only these specimens were trained on; specimen 2 has most of the frames."""
    specimen = np.array([0] * 5 + [1] * 5 + [2] * 30)
    data = dataclasses.replace(make(40, specimens=3, specimen=specimen), names=names)
    kept = np.flatnonzero(np.isin(specimen, specimens))
    settings = SimpleNamespace(split=lambda _: (kept, kept, kept))
    return _left_out(data, SimpleNamespace(pipeline=SimpleNamespace(settings=settings)))


def test_an_own_sensor_that_was_not_trained_on_is_named():
    (warning,) = left_out([0, 1])
    assert "10 of 40 frames" in warning
    assert "cast 7 not among them" in warning
    assert "--seed" in warning


def test_so_are_few_frames_of_many_without_names():
    (warning,) = left_out([0, 1], Names())
    assert "10 of 40 frames" in warning
    assert "not among them" not in warning


def test_nothing_is_said_where_most_were_trained_on():
    assert left_out([1, 2]) == []
    assert left_out([0, 2], Names({0: "a", 2: "b"})) == []
