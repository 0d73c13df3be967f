"""Pipelines trained for layouts: what is trained on, what is kept, and what is said of it."""

import dataclasses

import numpy as np
import pytest
from layouts_fakes import flat_bound

from eitskin.benchmarks.layouts.candidates import paper
from eitskin.benchmarks.results import read_results
from eitskin.benchmarks.studies.layouts import layouts_trained, lesson
from eitskin.benchmarks.studies.layouts.layouts_trained import compared, main, one_sided
from eitskin.benchmarks.studies.layouts.lesson import (
    QUICK,
    Learned,
    Lesson,
    learn_all,
    ratio_error,
)
from eitskin.datasets.recipe.frame_sampling import sample, specimen


def result(name, bound, error):
    errors = {"found": 0.02}
    return Learned(name, 28, bound, 2.0, 0.1, error, error, error, 0.9, 0.1, 1.0, errors, 500, 9.0)


def test_layouts_get_the_same_scenes_on_other_sensors_in_the_test():
    amount = Lesson()
    one, other = (amount.training(each.design) for each in (paper(), one_sided()))
    for index in (0, 17, one.frames - 1):
        assert sample(one, index) == sample(other, index)
    unseen = amount.testing(paper().design)
    assert one.specimens.electrode_place > 0
    assert specimen(one, 0).design.electrodes != specimen(unseen, 0).design.electrodes
    assert one.frames == amount.sensors + amount.bends + 2 * amount.touches


def test_standard_errors_are_over_sensors_and_not_over_frames():
    """Frames that agree within each sensor say no more than one of each would."""
    off, sensor = np.array([1.0, 2.0, 4.0, 5.0]), np.arange(4)
    expected = off.std(ddof=1) / 2.0
    assert ratio_error(off, np.ones(4), sensor) == pytest.approx(expected)
    again = np.repeat(off, 10)
    assert ratio_error(again, np.ones(40), np.repeat(sensor, 10)) == pytest.approx(expected)
    assert np.isnan(ratio_error(off, np.ones(4), np.zeros(4, int)))


@pytest.mark.slow
def test_results_have_scores_errors_and_a_picture(tmp_path, monkeypatch):
    scores = [result("paper", 1.0, 2.0), result("poor", 10.0, None)]
    monkeypatch.setattr(layouts_trained, "learn_all", lambda *_, **__: scores)
    monkeypatch.setattr(layouts_trained, "compared", lambda _: [])
    monkeypatch.setattr("sys.argv", ["layouts_trained", "--out", str(tmp_path)])
    main()
    found = read_results(tmp_path / "layouts_trained" / "results.json").figures
    assert (found["paper / found"], found["paper / found, error"]) == (90.0, 2.0)
    assert "poor / error_mm" not in found
    picture = tmp_path / "layouts_trained" / "layouts_trained.png"
    assert picture.read_bytes()[:4] == b"\x89PNG"


def test_the_best_layout_with_mirrors_is_the_one_that_the_search_found():
    best = compared(quick=False)[1]
    middles = {(round(1e3 * e.x, 6), round(1e3 * e.y, 6)) for e in best.design.electrodes}
    long_sides = {(x, y) for x in (26.25, 75.0, 123.75) for y in (0.0, 60.0)}
    assert middles == long_sides | {(0.0, 30.0), (150.0, 30.0)}


@pytest.fixture
def trained(monkeypatch):
    """Names of layouts that were trained for; frames and pipelines cost nothing."""
    names = []
    monkeypatch.setattr(lesson, "_frames", lambda _, recipe: recipe)
    monkeypatch.setattr(lesson.Pipeline, "fit", staticmethod(lambda training, _: training))

    def score(layout, bound, pipeline, testing, seconds):  # noqa: ARG001
        assert pipeline.seed != testing.seed
        names.append(layout.name)
        return result(layout.name, float(1e3 * bound.place[0, 0]), 1.0 if len(names) > 1 else None)

    monkeypatch.setattr(lesson, "scored", score)
    return names


@pytest.mark.slow
def test_what_is_finished_is_not_trained_again(tmp_path, trained):
    layouts = [(paper(), flat_bound(1e-3)), (one_sided(), flat_bound(5e-3))]
    first = learn_all(layouts[:1], tmp_path, lesson=QUICK)
    assert trained == [paper().name]
    both = learn_all(layouts, tmp_path, lesson=QUICK)
    assert trained == [paper().name, one_sided().name]
    assert both[0] == first[0]
    assert [each.bound_rms_mm for each in both] == pytest.approx([1.0, 5.0])
    (path, *_) = tmp_path.glob("*.json")
    path.write_bytes(b"{")
    assert len(learn_all(layouts, tmp_path, lesson=QUICK)) == 2
    assert len(trained) == 3
    learn_all([(paper(), flat_bound(2e-3))], tmp_path, lesson=QUICK)
    assert len(trained) == 4


def test_a_layout_under_two_names_is_trained_once(tmp_path, trained):
    bound = flat_bound(1e-3)
    twice = [(paper(), bound), (dataclasses.replace(paper(), name="again"), bound)]
    found = learn_all(twice, tmp_path, lesson=QUICK)
    assert trained == ["again"]
    assert [each.layout for each in found] == [paper().name, "again"]
