"""`eitskin bench layouts --trained`: what is trained on, what is kept, and what is said of it."""

import dataclasses

import numpy as np
import pytest
from layouts_fakes import flat_bound

from eitskin.benchmarks.layouts.candidates import paper
from eitskin.benchmarks.studies.data import layouts_trained
from eitskin.benchmarks.studies.data.layouts_trained import (
    QUICK,
    Learned,
    Lesson,
    learn_all,
    one_sided,
)
from eitskin.benchmarks.studies.data.layouts_trained_report import rank_correlation
from eitskin.datasets.recipe.frame_sampling import sample, specimen


def result(name, bound, error):
    return Learned(name, 28, bound, 2.0, 0.1, error, error, error, 0.9, 0.1, 1.0, 500, 9.0)


def test_layouts_get_the_same_scenes_on_other_sensors_in_the_test():
    lesson = Lesson()
    one, other = (lesson.training(each.design) for each in (paper(), one_sided()))
    for index in (0, 17, one.frames - 1):
        assert sample(one, index) == sample(other, index)
    unseen = lesson.testing(paper().design)
    assert one.specimens.electrode_place > 0
    assert specimen(one, 0).design.electrodes != specimen(unseen, 0).design.electrodes
    assert one.frames == lesson.sensors + lesson.bends + 2 * lesson.touches


def test_ranks_agree_or_are_opposite():
    one = np.array([1.0, 2.0, 3.0, 4.0])
    assert rank_correlation(one, one**3) == pytest.approx(1.0)
    assert rank_correlation(one, -one) == pytest.approx(-1.0)


@pytest.fixture
def trained(monkeypatch):
    """Names of layouts that were trained for; frames and pipelines cost nothing."""
    names = []
    monkeypatch.setattr(layouts_trained, "_frames", lambda _, recipe: recipe)
    monkeypatch.setattr(layouts_trained.Pipeline, "fit", staticmethod(lambda training, _: training))

    def score(layout, bound, pipeline, testing, seconds):  # noqa: ARG001
        assert pipeline.seed != testing.seed
        names.append(layout.name)
        return result(layout.name, float(1e3 * bound.place[0, 0]), 1.0 if len(names) > 1 else None)

    monkeypatch.setattr(layouts_trained, "scored", score)
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
