"""`eitskin bench stability`: how cases are judged, and that the command finds what is wrong."""

import csv
import json
import time
import warnings
from dataclasses import replace

import numpy as np
import pytest
from command_line import printed_json, run
from hypothesis import given, settings
from hypothesis import strategies as st

from eitskin.benchmarks.results import read_results
from eitskin.benchmarks.stability import electrical, extremes, mechanical
from eitskin.benchmarks.stability import run as stability
from eitskin.benchmarks.stability.case import Case, CaseValues, judge
from eitskin.benchmarks.stability.run import random_designs
from eitskin.errors import ConfigurationError
from eitskin.geometry import SensorDesign
from eitskin.simulator import ForwardModel
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.load_stepping import SolidError, follow

pytestmark = pytest.mark.slow


def found(**values):
    return Case("name", lambda: CaseValues(**values))


def failing(error, **options):
    def solve():
        raise error

    return Case("name", solve, **options)


def warning():
    warnings.warn("overflow encountered", RuntimeWarning, stacklevel=1)
    return CaseValues()


def endless():
    while True:
        time.perf_counter()


REFUSAL = ConfigurationError("at most 10 deg")


@pytest.mark.parametrize(
    ("case", "outcome", "reason"),
    [
        (found(residual=1e-9, invariant=1e-7, error=1e-4), "ok", ""),
        (found(error=2e-3), "wrong", "error of 0.002"),
        (found(invariant=1e-5), "wrong", "invariant of 1e-05"),
        (replace(found(residual=1e-2), residual_limit=1e-6), "wrong", "residual of 0.01"),
        (found(error=np.nan), "wrong", "error is not a number"),
        (found(residual=np.inf), "wrong", "residual is not a number"),
        (failing(ZeroDivisionError()), "wrong", "ZeroDivisionError"),
        (Case("name", warning), "wrong", "RuntimeWarning: overflow encountered"),
        (Case("name", endless), "wrong", "TimeoutError"),
        (failing(ImportError("pip install it")), "left out", "pip install it"),
        (failing(REFUSAL, expected=None), "refused", "at most 10 deg"),
        (failing(REFUSAL, expected="refused", says="10 deg"), "refused", "at most 10 deg"),
        (failing(REFUSAL, expected="refused", says="20 deg"), "wrong", "20 deg"),
        (failing(REFUSAL), "wrong", "was refused: at most 10 deg"),
        (replace(found(error=0.0), expected="refused"), "wrong", "was not refused"),
        (replace(found(error=1e-4, reason="no"), expected=None), "refused", "no"),
        (replace(found(error=1.0, reason="no"), expected=None), "wrong", "error of 1"),
    ],
)
def test_every_case_has_an_outcome_and_a_reason(case, outcome, reason):
    row = judge(case, patience=0.05 if case.solve is endless else 300.0)
    assert row["outcome"] == outcome
    assert reason in row["reason"]
    assert all(value is None or np.isfinite(value) for value in (row["residual"], row["error"]))


def test_the_heat_balance_sees_a_wrong_conductivity():
    model = ForwardModel(SensorDesign.reference(), "fast")
    assert electrical.imbalance(model) < 1e-11
    exact = model.sensitivity
    model.sensitivity = lambda *scene: 1.001 * exact(*scene)
    assert electrical.imbalance(model) > 1e-4


@pytest.mark.parametrize(
    ("cases", "name", "outcome"),
    [
        (mechanical.bends, "whole length to 360 deg", "ok"),
        (mechanical.bends, "hinge, up, to the end", "ok"),
        (mechanical.bends, "hinge, up, past it", "refused"),
        (mechanical.rolls_and_twists, "roll, 360 deg", "ok"),
        (mechanical.compositions, "press, arc of 360 deg", "ok"),
        (mechanical.compositions, "two presses 0 mm apart", "refused"),
        (mechanical.incompressible, "nu = 0.49999", "ok"),
        (electrical.ordinary_designs, "disc", "ok"),
    ],
)
def test_deformations_are_right_to_their_ends(cases, name, outcome):
    (case,) = (each for each in cases(quick=True) if each.name == name)
    assert judge(case)["outcome"] == outcome


EXTREMES = [
    *electrical.contrasts((1e-6, 1e6)),
    *electrical.layers((1e-6, 1e6), (0.5, 0.01)),
    *electrical.contacts(),
    *electrical.electrodes(quick=False),
]
LONG = ("half a sensor", "2 mm high")


@pytest.mark.parametrize(
    "case", [e for e in EXTREMES if not e.name.startswith(LONG) and "but 1e6" not in e.name]
)
def test_extreme_sizes_contrasts_and_contacts_have_their_closed_forms_or_are_refused(case):
    row = judge(case)
    assert row["outcome"] in ("ok", "refused"), row["reason"]


def test_presses_extreme_in_too_many_ways_are_refused_with_what_was_compared():
    refused = [e for e in extremes.extremes(quick=False) if e.expected == "refused"]
    assert len(refused) == 4
    for case in refused:
        row = judge(case)
        means = "thickness of 12 mm" if "gap" in case.name else "0.33 or more"
        assert (row["outcome"], means in row["reason"]) == ("refused", True)


def test_a_press_says_how_far_it_went_and_why_no_farther(monkeypatch):
    to_depth = AxisymmetricPress.to_depth

    def stuck(_):
        raise SolidError("no equilibrium")

    def shallow(self, depth):
        if depth > 0.004:
            follow((), np.zeros(1), stuck)
        return to_depth(self, depth)

    monkeypatch.setattr(AxisymmetricPress, "to_depth", shallow)
    (case,) = mechanical.presses(quick=True)
    row = judge(case)
    assert (row["outcome"], row["reached"][:10]) == ("refused", "30% deep, ")
    assert row["residual"] < 1e-9
    assert row["invariant"] < 1e-4


@settings(max_examples=12, derandomize=True)
@given(st.integers(0, 2**32 - 1))
def test_any_design_gives_a_frame_or_a_refusal_that_follows_the_seed(seed):
    row, again = (judge(case) for _ in range(2) for case in random_designs(seed, 1))
    assert row["outcome"] in ("ok", "refused"), row["reason"]
    assert row | {"seconds": 0.0} == again | {"seconds": 0.0}


def test_the_command_writes_all_rows_and_ends_with_1_where_one_is_wrong(tmp_path, monkeypatch):
    cases = [
        found(error=1e-5, reached="12 deg", figures={"GB": 2.0}),
        failing(REFUSAL, expected="refused"),
    ]
    monkeypatch.setattr(stability, "cases", lambda *_: {"family": cases})
    words = ("bench", "stability", "--seed", "4", "--out", str(tmp_path))
    data = printed_json(*words)
    assert (data["figures"]["all.ok"], data["provenance"]["seed"]) == (1, 4)
    assert data["figures"]["name / GB"] == 2.0
    _, *lines = (tmp_path / "stability" / "table.csv").read_text().splitlines()
    for rows in (data["rows"], list(csv.DictReader(lines))):
        assert [row["outcome"] for row in rows] == ["ok", "refused"]
    assert read_results(tmp_path / "stability" / "results.json").figures["family.error"] == 1e-5
    cases.append(failing(RuntimeError("oh")))
    ran = run(*words, "--json", "--quiet", code=1)
    assert json.loads(ran.stdout)["figures"]["all.wrong"] == 1
