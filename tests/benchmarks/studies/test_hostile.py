"""Hostile inputs of every kind, a few of each: read, or one clear error."""

import random

import pytest

from eitskin.benchmarks.studies.data import hostile
from eitskin.benchmarks.studies.data.hostile_inputs import EXTREMES, damaged, misworded, trials
from eitskin.errors import EitskinError

CHEAP = ("TOML", "manifests", "bytes")


def test_every_cheap_kind_is_read_or_refused_in_a_sentence(tmp_path, monkeypatch):
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path))
    for kind, (trial, _) in trials().items():
        if kind.startswith(CHEAP):
            for number in range(30):
                found, message = hostile._outcome(trial, 7, kind, number, tmp_path)
                assert found in hostile.OUTCOMES[:2], (kind, number, message)


@pytest.mark.slow
def test_every_kind_is_tried_in_a_process_that_is_watched():
    found = list(hostile.run(seed=7, most=6))
    assert {kind for kind, *_ in found} == set(trials())
    assert not [each for each in found if each[2] not in hostile.OUTCOMES[:2]]


def test_what_is_looked_for_is_told(tmp_path):
    def outcome(trial):
        return hostile._outcome(trial, 0, "a", 0, tmp_path)[0]

    def fail(error):
        def trial(*_):
            raise error

        return trial

    assert outcome(lambda *_: None) == "read"
    assert outcome(fail(EitskinError("x"))) == "one clear error"
    assert outcome(fail(EitskinError("x" * 10_000))) == "traceback"
    assert outcome(fail(KeyError("x"))) == "traceback"


def test_inputs_are_the_same_again():
    text = "a = 1\nb = 2.5e-3\nc = [3, 4]"
    made = [[misworded(random.Random(n), text) for n in range(50)] for _ in range(2)]
    assert made[0] == made[1]
    assert any(extreme in each for each in made[0] for extreme in EXTREMES[:9])
    assert len({damaged(random.Random(n), b"0123456789" * 9) for n in range(50)}) > 40
