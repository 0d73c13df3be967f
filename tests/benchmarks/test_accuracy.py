"""Benchmarks of physics: accuracy and the simulated world."""

from functools import partial

import numpy as np
import pytest
from command_line import printed_json

from eitskin.benchmarks import accuracy
from eitskin.benchmarks import forward_models as models
from eitskin.benchmarks.accuracy import QUICK_SCENES
from eitskin.benchmarks.forward_models import Drop, Truth, drops, judge, model_frame
from eitskin.benchmarks.world import (
    KINEMATIC,
    SOLVED_MODEL,
    TABLE_MODEL,
    ModelError,
    cases,
    figures,
)
from eitskin.geometry import SensorDesign
from eitskin.geometry.meshing.grading import Grading


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Results of few drops, each model timed once: times are not looked at here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(accuracy, "judge", partial(judge, least_seconds=0.0))
        patch.setattr(models, "drops", partial(drops, count=3))
        patch.setattr(models, "QUICK_PEERS", (models.uniform(9e-3, 1),))
        words = ("bench", "accuracy", "--quick", "--seed", "3")
        return printed_json(*words, "--out", tmp_path_factory.mktemp("bench"))


@pytest.fixture(scope="module")
def truth() -> Truth:
    """A coarse one: enough where only the arithmetic is looked at."""
    design = SensorDesign.reference()
    coarse = models.ModelCase("", "", ((2, 1), Grading(2e-3, 8e-3, 1.0)))
    frame = model_frame(coarse.model(design))
    changes = drops(design, seed=1, count=2)
    flat = frame(None)
    return Truth(design, changes, flat, np.array([frame(d) - flat for d in changes]), 0.0, 0.0)


@pytest.mark.slow
def test_errors_fall_with_the_resolution_and_stay_above_the_references_own(data):
    coarse, fast = (row for row in data["rows"] if row["family"] == "hexahedra, named")
    for quantity in ("resistance_error", "signal_error"):
        assert fast[quantity] < 0.5 * coarse[quantity]
        assert fast[quantity] > 10 * data["figures"][f"references.{quantity}"]
    assert fast["unknowns"] > coarse["unknowns"]
    for scene, limit in zip(QUICK_SCENES, (1e-3, 2.5e-3), strict=True):
        check, fast = (
            data["figures"][f"bent and pressed, {name}.{scene}"]
            for name in ("second reference", "fast")
        )
        assert check < fast < limit
    for kind in accuracy.QUICK_ELECTRODES:
        modes, fast = (
            data["figures"][f"electrodes {kind}{name}_error"]
            for name in (".reference", ", fast.resistance")
        )
        assert 10 * modes < fast < 5e-3


def test_judge_measures_the_errors_of_a_frame_and_the_drop_is_smooth(truth):
    def frame(drop):
        change = 0.0 if drop is None else truth.signals[truth.drops.index(drop)]
        wrong = np.where(np.arange(28) == 5, 1.02, 1.01)
        return wrong * truth.resistances + 1.1 * change

    found = judge(frame, truth, least_seconds=0.0)
    assert found["resistance_error"] == pytest.approx(0.02)
    assert found["signal_error"] == pytest.approx(0.1)
    drop = Drop(0.05, 0.02, 0.005, background=2.0)
    points = np.array([[0.05, 0.02, 0.005], [0.058, 0.02, 0.005], [0.15, 0.06, 0.0]])
    assert drop(points) == pytest.approx([1.4, 2.0 * (1 - 0.3 / np.e), 2.0])


# The world of tables and solutions


CASES = {case.name: case for case in cases()}


def error(case, value, model=TABLE_MODEL, kind="press", borrows=True):
    return ModelError(case, kind, model, value, 0.1, 0.02, borrows)


def test_errors_are_the_median_and_worst_of_tables_and_of_what_presses_change():
    errors = (
        *(error("a", 0.01), error("b", 0.05)),
        *(error("a", 0.2, SOLVED_MODEL), error("c", 0.02, SOLVED_MODEL, borrows=False)),
        error("d", 0.003, kind="bend", borrows=False),
    )
    named = dict(figures(errors))
    assert named["press / default, median [%]"] == 2.0
    assert named["press / default, cases"] == 3
    assert named["press / default, borrowing nothing, cases"] == 1
    assert named["press / default, borrowing nothing, median [%]"] == 2.0
    assert named["press / solved, worst [%]"] == 20.0
    assert named["bend / default, worst [%]"] == pytest.approx(0.3)
    flat, bent = CASES["plates_45_30"], CASES["plates_45_30_30deg"]
    assert (flat.signal == flat.changes).all()
    # Bent or flat, a press changes about as much; the bend alone changes ten times more.
    pressed, touched = (np.linalg.norm(case.signal) for case in (flat, bent))
    assert pressed == pytest.approx(touched, rel=0.03)
    assert np.linalg.norm(bent.changes) > 5.0 * touched


@pytest.mark.slow
def test_a_quick_run_compares_a_press_and_a_bend(tmp_path):
    data = printed_json("bench", "world", "--quick", "--out", tmp_path)
    found = {(row["case"], row["model"]): row["error"] for row in data["rows"]}
    for case, limit in (("75_30", 0.04), ("independent_bend_20", 0.005)):
        assert found[case, TABLE_MODEL] < limit
    assert found["independent_bend_20", KINEMATIC] > 0.5
    assert (tmp_path / "world" / "world.png").stat().st_size > 10_000
