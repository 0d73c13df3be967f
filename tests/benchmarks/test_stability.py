"""`eitskin bench stability`: what it holds against what, and that it finds what is wrong."""

import csv
import dataclasses
import json
import time
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from eitskin.benchmarks.results import read_results
from eitskin.benchmarks.stability import bends as stability_bends
from eitskin.benchmarks.stability import electrical as stability_electrical
from eitskin.benchmarks.stability import run as stability
from eitskin.benchmarks.stability import solids as stability_solids
from eitskin.benchmarks.stability.case import Case, CaseValues, judge
from eitskin.benchmarks.stability.closed_forms import punched_layer, sector
from eitskin.benchmarks.stability.random_designs import random_designs
from eitskin.cli.main import app
from eitskin.errors import ConfigurationError
from eitskin.geometry import SensorDesign
from eitskin.simulator import ForwardModel
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.load_stepping import SolidError

import closed_forms

pytestmark = pytest.mark.slow


def found(**values):
    return Case("name", lambda: CaseValues(**values))


def failing(error, **options):
    def solve():
        raise error

    return Case("name", solve, **options)


# Outcomes of a case


def test_a_number_within_its_limits_is_ok() -> None:
    row = judge(found(residual=1e-9, invariant=1e-7, error=1e-4, reached="far"))
    assert (row.outcome, row.reason, row.reached) == ("ok", "", "far")
    assert (row.residual, row.invariant, row.error) == (1e-9, 1e-7, 1e-4)


def warning():
    warnings.warn("overflow encountered", RuntimeWarning, stacklevel=1)
    return CaseValues()


def dividing():
    return CaseValues(error=1 / 0)


@pytest.mark.parametrize(
    ("case", "reason"),
    [
        (found(error=2e-3), "error of 0.002"),
        (found(invariant=1e-5), "invariant of 1e-05"),
        (dataclasses.replace(found(residual=1e-2), residual_limit=1e-6), "residual of 0.01"),
        (found(error=np.nan), "error is not a number"),
        (found(residual=np.inf), "residual is not a number"),
        (Case("name", dividing), "ZeroDivisionError"),
        (Case("name", warning), "RuntimeWarning: overflow encountered"),
    ],
)
def test_numbers_beyond_limits_errors_and_warnings_are_wrong(case, reason) -> None:
    row = judge(case)
    assert row.outcome == "wrong"
    assert reason in row.reason
    json.dumps(dataclasses.asdict(row), allow_nan=False)


def test_hangs_are_wrong_and_end() -> None:
    def solve():
        while True:
            time.perf_counter()

    row = judge(Case("name", solve), patience=0.05)
    assert (row.outcome, row.reason) == ("wrong", "TimeoutError: took longer than 0.05 s")
    assert row.seconds < 1.0


def test_refusals_are_fine_where_they_are_expected_and_say_why() -> None:
    error = ConfigurationError("at most 10 deg")
    for options in ({"expected": None}, {"expected": "refused", "says": "10 deg"}):
        assert judge(failing(error, **options)).outcome == "refused"
    assert judge(failing(error, expected="refused", says="20 deg")).outcome == "wrong"
    assert judge(failing(error)).reason == "was refused: at most 10 deg"
    accepted = dataclasses.replace(found(error=0.0), expected="refused")
    assert judge(accepted).reason == "was not refused"


def test_numbers_found_before_a_refusal_are_kept_and_judged() -> None:
    case = dataclasses.replace(found(error=1e-4, reached="half", reason="no"), expected=None)
    row = judge(case)
    assert (row.outcome, row.error, row.reached, row.reason) == ("refused", 1e-4, "half", "no")
    off = dataclasses.replace(found(error=1.0, reason="no"), expected=None)
    assert judge(off).outcome == "wrong"


def test_what_is_not_installed_is_left_out() -> None:
    row = judge(failing(ImportError("pip install it")))
    assert (row.outcome, row.reason) == ("left out", "pip install it")


def test_an_interrupt_is_not_swallowed() -> None:
    with pytest.raises(KeyboardInterrupt):
        judge(failing(KeyboardInterrupt()))


# Closed forms


def test_punched_layer_is_a_half_space_when_it_is_thick() -> None:
    """The published factors are in `test_axisymmetric_press`."""
    assert punched_layer(1e-3, 1.0, 0.3) == pytest.approx(4e-3 / 0.7, rel=2e-3)


def test_sector_is_between_two_radii_and_thin_ones_are_bars() -> None:
    angle, length, height, stretch = 2.0, 0.1, 0.02, 1.05
    curvature = angle / length
    inner, outer = np.sqrt(stretch**2 + curvature * height * np.array([-1, 1])) / curvature
    expected = closed_forms.sector_between_ends(angle, inner, outer)
    assert sector(angle, height, 1.0, stretch, length) == pytest.approx(expected)
    assert sector(-1e-6, height, 2.0, 1.0, length) == pytest.approx(length / (2.0 * height))


# The cases themselves


def named(cases, *names):
    picked = {case.name: case for case in cases if case.name in names}
    assert set(picked) == set(names)
    return [judge(picked[name]) for name in names]


def test_electrical_cases_are_right_and_refusals_refused() -> None:
    rows = [
        *map(judge, stability_electrical.contrasts((1e6,))),
        *map(judge, stability_electrical.layers((1e-6,), (0.01,))),
        *named(stability_electrical.contacts(), "block, 1e+03", "block, 1e-09, 1e+03", "nan"),
        *named(stability_electrical.electrodes(quick=True), "1 um", "one on the other"),
        *named(
            stability_electrical.cells(quick=True),
            "15000 : 1 needle, hexahedra",
            "hexahedra sheared by 10000",
        ),
    ]
    refused = [row.case for row in rows if row.outcome == "refused"]
    assert refused == ["nan", "one on the other", "hexahedra sheared by 10000"]
    assert all(row.outcome != "wrong" for row in rows)
    assert all(row.error is not None and row.invariant < 1e-4 for row in rows if row.residual)


def test_the_heat_balance_sees_a_wrong_conductivity() -> None:
    model = ForwardModel(SensorDesign.reference(), "fast")
    assert stability_electrical.imbalance(model) < 1e-11
    exact = model.sensitivity
    model.sensitivity = lambda *scene: 1.001 * exact(*scene)
    assert stability_electrical.imbalance(model) > 1e-4


def test_bends_are_right_to_their_ends_and_the_ends_are_named() -> None:
    rows = named(
        stability_bends.bends(quick=True),
        "whole length to 360 deg",
        "whole length to 360.1 deg",
        "hinge, up, to the end",
        "hinge, up, past it",
    )
    assert [row.outcome for row in rows] == ["ok", "refused"] * 2
    assert rows[0].error < 1e-6
    assert rows[2].reached == "148.7 deg"
    rows = named(stability_bends.rolls_and_twists(quick=True), "roll, 360 deg", "twist, 10 turns")
    assert [row.outcome for row in rows] == ["ok", "ok"]


def test_presses_and_bends_compose_or_are_refused() -> None:
    rows = named(
        stability_bends.compositions(quick=True),
        "press, arc of 360 deg",
        "two presses 0 mm apart",
    )
    assert [row.outcome for row in rows] == ["ok", "refused"]


def test_layers_do_not_lock() -> None:
    compressible, stiff = named(
        stability_solids.incompressible(quick=True), "nu = 0.3", "nu = 0.49999"
    )
    assert max(compressible.error, stiff.error) < 2e-3


def test_a_press_says_how_far_it_went_and_why_no_farther(monkeypatch) -> None:
    to_depth = AxisymmetricPress.to_depth

    def shallow(self, depth):
        if depth > 0.004:
            raise SolidError("the solid carries 40.0% of the load only")
        return to_depth(self, depth)

    monkeypatch.setattr(AxisymmetricPress, "to_depth", shallow)
    (case,) = stability_solids.presses(quick=True)
    row = judge(case)
    assert row.outcome == "refused"
    assert row.reason.startswith("the solid carries 40.0%")
    assert row.reached.startswith("30% deep, ")
    assert row.residual < 1e-9
    assert row.invariant < 1e-4


# Random designs


@settings(max_examples=12, derandomize=True, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_any_design_gives_a_frame_or_a_refusal(seed) -> None:
    (case,) = random_designs(seed, 1)
    row = judge(case)
    assert row.outcome in ("ok", "refused"), row.reason
    assert bool(row.reason) == (row.outcome == "refused")


def test_random_designs_follow_the_seed_and_are_often_possible() -> None:
    first, again = (
        [dataclasses.replace(judge(case), seconds=0.0) for case in random_designs(5, 6)]
        for _ in range(2)
    )
    assert first == again
    assert len({row.reason for row in first}) > 1
    assert any(row.outcome == "ok" for row in first)


# The command


def bench(folder, monkeypatch, cases, *options):
    monkeypatch.setattr(stability, "cases", lambda *_: {"family": cases})
    return CliRunner().invoke(app, ["bench", "stability", "--out", str(folder), *options])


GOOD = found(error=1e-5, reached="12 deg")
REFUSED = failing(ConfigurationError("no"), expected="refused")
BAD = failing(RuntimeError("oh"))


def test_the_command_writes_all_rows_and_ends_with_1_where_one_is_wrong(
    tmp_path, monkeypatch
) -> None:
    assert bench(tmp_path, monkeypatch, [GOOD, REFUSED]).exit_code == 0
    ran = bench(tmp_path, monkeypatch, [GOOD, REFUSED, BAD], "--json", "--quiet", "--seed", "4")
    assert ran.exit_code == 1
    data = json.loads(ran.stdout)
    assert (data["figures"]["all.wrong"], data["provenance"]["seed"]) == (1, 4)
    folder = tmp_path / "stability"
    assert data["files"] == [str(folder / "table.csv"), str(folder / "results.json")]
    _, *lines = (folder / "table.csv").read_text().splitlines()
    rows = list(csv.DictReader(lines))
    for some in (data["rows"], rows):
        assert [one["outcome"] for one in some] == ["ok", "refused", "wrong"]
    assert (float(rows[0]["error"]), rows[1]["error"]) == (1e-5, "")
    figures = read_results(folder / "results.json").figures
    assert (figures["all.cases"], figures["all.ok"], figures["all.wrong"]) == (3, 1, 1)
    assert figures["family.error"] == 1e-5


def test_no_two_cases_have_the_same_name() -> None:
    for quick in (True, False):
        for cases in stability.cases(0, quick).values():
            names = [case.name for case in cases]
            assert len(set(names)) == len(names)
