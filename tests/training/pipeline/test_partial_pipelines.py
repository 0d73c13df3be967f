"""Pipelines of sets without bends, without touches, or of angles alone."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest

from eitskin.datasets import State
from eitskin.errors import ConfigurationError
from eitskin.simulator import Frame
from eitskin.threads import one_torch_thread
from eitskin.training import (
    NetworkSettings,
    Pipeline,
    Targets,
    TrainingSettings,
    evaluate,
    open_pipeline,
)
from eitskin.training.evaluation import selection
from eitskin.training.evaluation.evaluate import Evaluation
from eitskin.training.evaluation.report import table_rows
from eitskin.training.evaluation.selection import Selection, Trial, data_warnings, quantity_losses
from eitskin.training.method import input_spec
from eitskin.training.paper import method as paper_method

from made_up_sensor import FLAT
from made_up_sensor import frames as made_up_frames

pytestmark = pytest.mark.slow

BRIEF = NetworkSettings(1e-3, epochs=1, batch=32)
SETTINGS = TrainingSettings(classifier=BRIEF, postprocessor=BRIEF, bend_squares=False)


def frames(kept, **changes):
    """Idle, bent, and flat touched frames of three specimens, of which some states are kept."""
    made = made_up_frames(48, most=1, specimens=3)
    bent = (made.state == State.TOUCH) & (made.bend_angle_deg != 0)
    moved = np.where(bent[:, None], made.impedance * FLAT / made.touch_reference, made.impedance)
    made = dataclasses.replace(
        made,
        impedance=moved,
        touch_reference=np.where(bent[:, None], FLAT, made.touch_reference),
        bend_angle_deg=np.where(bent, 0.0, made.bend_angle_deg),
    )
    return dataclasses.replace(made.select(np.isin(made.state, kept)), **changes)


@pytest.fixture(scope="module", autouse=True)
def _quick():
    """Maps of few pixels, and a Jacobian of nothing in particular in place of a simulated one."""
    jacobian = np.random.default_rng(1).standard_normal((28, 8 * 16))
    with pytest.MonkeyPatch.context() as patch, one_torch_thread():
        patch.setattr(input_spec, "PIXELS", 160)
        model = SimpleNamespace(relative=jacobian)
        patch.setattr(paper_method, "linear_model", lambda *_: model)
        yield


@pytest.fixture(scope="module")
def never_bent(tmp_path_factory):
    data = frames([State.IDLE, State.TOUCH], bend_angle_deg=np.full(32, np.nan))
    return trained(data, tmp_path_factory.mktemp("never-bent"))


@pytest.fixture(scope="module")
def never_touched(tmp_path_factory):
    return trained(frames([State.IDLE, State.BEND]), tmp_path_factory.mktemp("never-touched"))


def trained(data, folder):
    """Pipeline of a set, as it is after saving and loading."""
    path = folder / "some.eitmodel"
    Pipeline.fit(data, SETTINGS).save(path)
    return open_pipeline(path)


def session(pipeline, data):
    """Estimates of a session that begins flat."""
    values = [FLAT, *data.impedance]
    return [
        pipeline.process(Frame(value.astype(complex), data.protocol, i, i, 0, data.frequency))
        for i, value in enumerate(values)
    ]


def test_a_gel_that_is_never_bent(never_bent, tmp_path):
    pipeline, data = never_bent, frames([State.IDLE, State.TOUCH])
    assert pipeline.targets == Targets(("idle", "touch"), angle=False, force=False)
    for estimate in session(pipeline, data)[:4]:
        assert estimate.bend_angle_deg is estimate.bend_deviation_deg is None
        assert np.isnan(estimate.probabilities[State.BEND])
        assert estimate.probabilities[:2].sum() == pytest.approx(1.0)
        assert estimate.state in {State.IDLE, State.TOUCH}
        assert estimate.touch_map.shape == (8, 16)
    card = (pipeline.save(tmp_path / "some.eitmodel") / "README.md").read_text()
    assert "(idle or touch)" in card
    assert "bend angle" not in card
    with pytest.raises(ConfigurationError, match="trained without bends"):
        pipeline.calibrate([], [])
    report = evaluate(pipeline, frames(list(State)))
    assert report.states.left_out == 16
    assert report.states.accuracy["bend"] is report.bend.rmse_deg is None
    rows = {name.strip(): here for name, _, here in table_rows(report)}
    assert rows["not estimated"] == "the state bend, the bend angle, forces"
    assert rows["frames of another state"] == "16, not scored"
    assert not any("bend" in name for name in rows)


def test_a_gel_that_is_never_touched(never_touched):
    pipeline, data = never_touched, frames([State.IDLE, State.BEND])
    assert pipeline.targets.missing == ("the state touch", "positions of touches")
    estimates = session(pipeline, data)
    for estimate, angle in zip(estimates[1:], data.bend_angle_deg, strict=True):
        assert estimate.bend_angle_deg == pytest.approx(angle, abs=3.0)
        assert (estimate.touches, estimate.touch_map) == (None, None)
    report = evaluate(pipeline, data)
    assert report.bend.rmse_deg < 3.0
    assert (report.touches, report.untouched) == ({}, None)


def test_methods_are_chosen_by_held_out_specimens_what_is_not_estimated_as_guessed(
    never_touched, monkeypatch
):
    """The joint method is refused for so few frames; what is left is chosen, and doubted."""
    data, told = frames([State.IDLE, State.TOUCH]), []
    found = Selection.from_dataset(
        data, seed=2, epochs=1, progress=lambda stage, *_: told.append(stage)
    )
    assert found.preset == "quick"
    assert "at least 100 frames" in found.trials[0].refusal
    assert set(told) == {"quick: state classifier", "quick: touch map"}
    pipeline = found.evaluation.pipeline
    assert len(np.unique(data.specimen[pipeline.held_out(data)])) == 1
    assert pipeline.metrics["selection"][1]["losses"].keys() == {"state", "touches"}
    assert json.dumps(pipeline.metrics["selection"], allow_nan=False)
    warnings = data_warnings(data, found.evaluation)
    assert "3 specimens are few, 1 of them held out" in warnings[0]
    assert "16 frames of the state idle are few" in warnings[1]
    assert "positions (0% of single touches within 15 mm): hardly better" in warnings[-1]
    data = frames(list(State))
    losses = quantity_losses(
        Evaluation.from_dataset(never_touched, data), Targets.from_dataset(data)
    )
    assert losses["touches"] == 1.0
    assert losses["angle"] < 0.2
    assert losses["state"] >= 1 / 3  # no touch is recognised
    # A brief comparison leaves those that may win, and the last word has the whole training.
    evaluation, trained = Evaluation.from_dataset(never_touched, data), []
    brief, whole = {"joint": 0.2, "quick": 0.3, "paper": 0.5}, {"joint": 0.2, "quick": 0.1}

    def trial(_data, preset, _settings, share, _progress):
        trained.append((preset, share < 1.0))
        loss = (whole if share == 1.0 else brief)[preset]
        return Trial(preset, 1.0, "", evaluation, {"x": loss}, share=share)

    monkeypatch.setattr(selection, "train_candidate", trial)
    found = Selection.from_dataset(data, presets=("joint", "quick", "paper"))
    assert found.preset == "quick"
    assert [preset for preset, briefly in trained if not briefly] == ["joint", "quick"]
    assert "0.500" in found.trials[2].stopped
    assert [each.seconds for each in found.trials] == [2.0, 2.0, 1.0]
    assert found.trials[2].as_dict()["stopped"]
    brief["quick"], whole["joint"] = 0.5, 0.3
    assert Selection.from_dataset(data).preset == "joint"
