"""`eitskin bench accuracy`: its errors and its files."""

from functools import partial

import numpy as np
import pytest
from command_line import printed_json

from eitskin.benchmarks import accuracy
from eitskin.benchmarks import forward_models as models
from eitskin.benchmarks.accuracy import QUICK_SCENES, published_error
from eitskin.benchmarks.forward_models import Drop, Truth, drops, judge, model_frame
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
def test_errors_fall_along_each_ladder_and_stay_above_the_references_own(data):
    names = "hexahedra, linear", "hexahedra, cubic, nested dissection", "prisms, quadratic"
    for name in names:
        first, second = (row for row in data["rows"] if row["family"] == name)
        for quantity in ("resistance_error", "signal_error"):
            assert second[quantity] < 0.5 * first[quantity]
            assert second[quantity] > 10 * data["figures"][f"references.{quantity}"]
        assert second["published_error"] < first["published_error"]
        assert second["unknowns"] > first["unknowns"]
    for scene, limit in zip(QUICK_SCENES, (1e-3, 2.5e-3, 3.5e-2), strict=True):
        check, fast = (
            data["figures"][f"bent and pressed, {name}.{scene}"]
            for name in ("second reference", "fast")
        )
        assert check < fast < limit


def test_judge_measures_the_errors_that_a_frame_has(truth):
    def frame(drop):
        change = 0.0 if drop is None else truth.signals[truth.drops.index(drop)]
        wrong = np.where(np.arange(28) == 5, 1.02, 1.01)
        return wrong * truth.resistances + 1.1 * change

    found = judge(frame, truth, least_seconds=0.0)
    assert found["resistance_error"] == pytest.approx(0.02)
    assert found["signal_error"] == pytest.approx(0.1)


def test_a_drop_is_30_percent_where_it_is_touched_and_smooth():
    drop = Drop(0.05, 0.02, 0.005, background=2.0)
    points = np.array([[0.05, 0.02, 0.005], [0.058, 0.02, 0.005], [0.15, 0.06, 0.0]])
    assert drop(points) == pytest.approx([1.4, 2.0 * (1 - 0.3 / np.e), 2.0])


@pytest.mark.slow
def test_the_published_error_is_that_of_the_published_contact_impedance():
    fine = models.ModelCase("", "", ((4, 1), Grading(2e-6, 6e-3, 2.0)))
    assert published_error(fine) < 3e-5
