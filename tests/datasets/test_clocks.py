"""Times of recordings on the clocks that loggers have."""

import numpy as np
import pytest

from eitskin.datasets import RecordingForm, RecordingNames, read_recording
from eitskin.datasets.recordings import recorded_file
from eitskin.errors import DataError


def read(tmp_path, times, unit="", session=None, **names):
    rows = [f"1,2,{t},{session[i] if session else 0}" for i, t in enumerate(times)]
    (tmp_path / "a.csv").write_text("\n".join(["v0,v1,t,session", *rows]))
    form = RecordingForm(time_unit=unit)
    return read_recording(tmp_path / "a.csv", RecordingNames(**names), form=form).time


@pytest.mark.parametrize(
    ("times", "unit", "steps"),
    [
        ([1763906400000, 1763906400300, 1763906400600], "ms", [0.3, 0.3]),
        ([0, 60, 120], "s", [60, 60]),
        ([100, 400, 700], "us", [3e-4, 3e-4]),
        ([4294966.995, 4294967.295, 0.299, 0.599], "", [0.3] * 3),  # s of a wrapping millis()
        ([2**32 - 301, 2**32 - 1, 299, 599], "ms", [0.3] * 3),
        ([2**32 - 400001, 2**32 - 200001, 2**32 - 1, 199999], "us", [0.2] * 3),
        ([f"2026-11-23T14:0{minute}:00Z" for minute in range(3)], "", [60, 60]),
    ],
)
def test_clocks_go_on_in_seconds(tmp_path, monkeypatch, times, unit, steps):
    monkeypatch.setattr(recorded_file, "BLOCK_ROWS", 3 if len(times) > 3 else 2)
    assert np.allclose(np.diff(read(tmp_path, times, unit)), steps, atol=1e-6)


@pytest.mark.parametrize(
    ("times", "unit", "message"),
    [
        ([1763906400000, 1763906400300], "", "--time-unit ms"),
        ([1234, 1534, 1834], "", "--time-unit ms"),
        ([0, 1, 2, 1], "", "backwards, from 2 to 1 s; .*--column session"),
        ([0, 1, 2, 1], "ms", "backwards"),
    ],
)
def test_times_that_cannot_be_seconds_are_refused(tmp_path, times, unit, message):
    with pytest.raises(DataError, match=message):
        read(tmp_path, times, unit)


def test_each_session_has_its_own_clock_and_a_factor_is_a_unit(tmp_path):
    assert read(tmp_path, [5, 6, 0, 1], session=[0, 0, 1, 1]).tolist() == [5, 6, 0, 1]
    assert np.allclose(read(tmp_path, [0, 40000], columns={"t": "t*0.001"}), [0, 40])
