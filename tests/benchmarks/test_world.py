"""`eitskin bench world`: errors against the reference, and files."""

import numpy as np
import pytest
from command_line import printed_json

from eitskin.benchmarks.world import (
    KINEMATIC,
    SOLVED_MODEL,
    TABLE_MODEL,
    ModelError,
    cases,
    figures,
    sentences,
)

CASES = {case.name: case for case in cases()}


def error(case, value, model=TABLE_MODEL, kind="press"):
    return ModelError(case, kind, model, value, 0.1, 0.02, None, None)


def test_median_and_worst_are_of_the_tables_and_of_3d_solutions_where_there_is_none():
    errors = (
        *(error("a", 0.01), error("b", 0.05), error("c", 1.1, KINEMATIC)),
        *(error("a", 0.2, SOLVED_MODEL), error("c", 0.02, SOLVED_MODEL)),
        error("d", 0.003, kind="bend"),
    )
    named = dict(figures(errors))
    assert named["press / default, median [%]"] == 2.0
    assert named["press / default, cases"] == 3
    assert named["press / solved, worst [%]"] == 20.0
    pressed, bent, *_ = sentences(errors)
    assert "median 2.00 % (target 2 %), worst 5.00 % at b (target 4 %)" in pressed
    assert "worst 0.30 % at d" in bent


def test_errors_of_bent_presses_are_of_what_the_presses_change():
    flat, bent = CASES["plates_45_30"], CASES["plates_45_30_30deg"]
    assert (flat.signal == flat.changes).all()
    # Bent or flat, a press changes about as much; the bend alone changes ten times more.
    pressed, touched = (np.linalg.norm(case.signal) for case in (flat, bent))
    assert pressed == pytest.approx(touched, rel=0.2)
    assert np.linalg.norm(bent.changes) > 5.0 * touched


@pytest.mark.slow
def test_a_quick_run_compares_a_press_and_a_bend(tmp_path):
    data = printed_json("bench", "world", "--quick", "--out", tmp_path)
    found = {(row["case"], row["model"]): row["error"] for row in data["rows"]}
    for case, limit in (("75_30", 0.04), ("independent_bend_20", 0.005)):
        assert found[case, TABLE_MODEL] < limit
        assert found[case, KINEMATIC] > 0.5
    assert (tmp_path / "world" / "world.png").stat().st_size > 10_000
