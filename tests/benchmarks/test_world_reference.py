"""The published reference solutions are whole, and of the cases that the command solves."""

import json
from pathlib import Path

import numpy as np
import pytest

from eitskin.benchmarks.reference.cases import cases
from eitskin.benchmarks.reference.run import described

PUBLISHED = Path(__file__).resolve().parents[2] / "benchmarks/published/world_reference.json"
FOUND = json.loads(PUBLISHED.read_text())


def test_names_of_cases_are_unique():
    names = [case.name for case in cases()]
    assert len(set(names)) == len(names)


OF_COMMAND = [one for one in FOUND["solutions"] if "provenance" not in one]


def test_solutions_from_elsewhere_say_so():
    others = [one for one in FOUND["solutions"] if "provenance" in one]
    assert {one["provenance"] for one in others} == {"independent finite-strain solution"}
    assert all(one["name"].startswith("independent_") for one in others)
    assert all(np.isfinite(one["changes"]).all() and len(one["changes"]) == 28 for one in others)


def test_published_solutions_are_of_cases_of_the_command():
    known = {case.name: described(case) for case in cases()}
    assert len(OF_COMMAND) > 40
    for solution in OF_COMMAND:
        case = known[solution["name"]]
        assert {key: solution[key] for key in case} == case
        if solution["changes"] is None:
            assert solution["refused"], solution["name"]
            continue
        assert len(solution["changes"]) == 28
        assert np.all(np.isfinite(solution["changes"])), solution["name"]
        assert len(solution["depth"]) == len(solution["touches"]), solution["name"]


def test_a_press_in_the_middle_has_the_sensors_symmetry():
    solutions = {one["name"]: one for one in FOUND["solutions"]}
    changes = np.array(solutions["75_30"]["changes"])
    assert changes[[0, 7, 22, 25]] == pytest.approx(changes[0], rel=1e-6)


def test_provenance_names_the_solver():
    assert FOUND["command"].startswith("python -m eitskin.benchmarks.reference.run")
    assert "ngsolve" in FOUND["provenance"]["packages"]
