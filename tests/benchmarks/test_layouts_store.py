"""`eitskin bench layouts`: what is kept of finished layouts, and going on from it."""

import multiprocessing
from contextlib import nullcontext
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from layouts_fakes import FEWEST, flat_bound, moved

from eitskin.benchmarks.layouts import bound as layouts_store
from eitskin.benchmarks.layouts.bound import judge_layouts
from eitskin.benchmarks.layouts.candidates import PAPER, paper
from eitskin.errors import PartialError


def asked(*layouts):
    return [(layout, FEWEST) for layout in layouts]


def judging(folder, workers=1, watch=lambda _: None):
    return nullcontext(partial(judge_layouts, folder, workers, watch))


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def fresh(tmp_path_factory):
    """A folder and bounds of a run that was not stopped."""
    folder = tmp_path_factory.mktemp("fresh")
    with judging(folder) as judge:
        return folder, judge(asked(paper(), paper(20.0)))


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_a_stopped_run_goes_on_to_the_same_bytes(fresh, tmp_path, workers):
    def stop(name):  # noqa: ARG001
        raise KeyboardInterrupt

    questions = asked(paper(), paper(20.0))
    many = questions + asked(*(paper(angle) for angle in (-20.0, -10.0, 10.0, 30.0)))
    with pytest.raises(KeyboardInterrupt), judging(tmp_path, workers, stop) as judge:
        judge(many)
    assert not multiprocessing.active_children()
    finished = {path: path.stat().st_mtime_ns for path in tmp_path.glob("[!.]*.json")}
    assert 1 <= len(finished) < len(many)
    with judging(tmp_path, workers) as judge:
        resumed = judge(questions)
        judge(questions)  # nothing is left to be done
    folder, whole = fresh
    assert contents(tmp_path).items() >= contents(folder).items()
    assert all(path.stat().st_mtime_ns == time for path, time in finished.items())
    for one, other in zip(whole, resumed, strict=True):
        np.testing.assert_array_equal(one.place, other.place)
        np.testing.assert_array_equal(one.spectrum, other.spectrum)


@pytest.fixture
def counted(monkeypatch):
    """Names of layouts that are judged; the bound is their first electrode's place."""
    names = []

    def judged(layout, sampling):  # noqa: ARG001
        names.append(layout.name)
        return flat_bound(layout.design.electrodes[0].x)

    monkeypatch.setattr(layouts_store, "sheet_bound", judged)
    return names


def test_only_what_is_the_same_is_taken_from_a_file(tmp_path, counted):
    with judging(tmp_path) as judge:
        judge(asked(moved(0.020), moved(0.020)))
        assert counted == ["moved"]
        (again,) = judge(asked(replace(moved(0.020), name="under another name")))
        assert again.place[0, 0] == 0.020
        assert counted == ["moved"]
        (other,) = judge(asked(moved(0.021)))
        assert other.place[0, 0] == 0.021
        assert counted == ["moved"] * 2
        judge([(moved(0.020), replace(FEWEST, snr_db=70.0))])
        judge(asked(replace(moved(0.020), angle_deg=10.0)))
        assert len(counted) == 4


def test_damaged_and_foreign_files_are_judged_anew(tmp_path, counted):
    with judging(tmp_path) as judge:
        judge(asked(moved(0.020)))
        (path,) = tmp_path.glob("*.json")
        whole = path.read_bytes()
        path.write_bytes(whole[:40])
        judge(asked(moved(0.020)))
        assert path.read_bytes() == whole
        path.write_bytes(b'{"asked": {}, "found": {}}')  # of version 0.2
        (found,) = judge(asked(moved(0.020)))
    assert found.place[0, 0] == 0.020
    assert len(counted) == 3


def test_what_cannot_be_written_is_said(tmp_path, counted, monkeypatch):
    def full(path, content):  # noqa: ARG001
        raise PartialError("no room")

    monkeypatch.setattr(layouts_store, "write_file", full)
    with pytest.raises(PartialError), judging(tmp_path) as judge:
        judge(asked(paper()))
    assert counted == [PAPER]
