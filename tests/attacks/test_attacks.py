"""A few trials of every kind of attack; `python tests/attacks/attacks.py` runs a thousand."""

import os

import pytest
from attacks import KINDS, attempt

TRIALS = {"live": 1, "disks": 8, "arguments": 60}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", KINDS)
def test_hostile_inputs_are_taken_or_refused(kind, tmp_path, monkeypatch):
    monkeypatch.chdir(os.curdir)
    for number in range(TRIALS.get(kind, 20)):
        outcome, why = attempt(kind, 0, number, tmp_path)
        assert outcome != "bad", f"{kind}, trial {number}: {why}"
