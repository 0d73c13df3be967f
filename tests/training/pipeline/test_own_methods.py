"""Methods of a user's own: fitted, saved, and opened by code that the user names."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
from command_line import printed_json, run

from eitskin.datasets import save_dataset
from eitskin.errors import ConfigurationError, DataError
from eitskin.training import (
    Method,
    Pipeline,
    Predictions,
    Targets,
    TrainingSettings,
    evaluate,
)
from eitskin.training.pipeline.methods import (
    MethodCodeError,
)

from made_up_sensor import FLAT, frames

PAGE = Path(__file__).resolve().parents[3] / "docs" / "how-to" / "own-method.md"


class Strongest(Method):
    """Place of the training touch whose frame is most alike; nothing else."""

    targets = Targets((), angle=False, force=False)

    def __init__(self, known, places, spec):
        self.known, self.places, self.spec = known, places, spec

    @classmethod
    def fit(cls, frames, settings, progress):
        one = frames.dataset.touch_count == 1
        x, y = (values[one, 0] for values in (frames.dataset.touch_x, frames.dataset.touch_y))
        progress("one pass", 1, 1)
        kept = settings.options.get("kept", 1000)
        return cls(frames.observations.dynamic[one][:kept], np.stack([x, y], 1)[:kept], frames.spec)

    def predict(self, observations):
        dV = np.nan_to_num(observations.dynamic)
        nearest = np.linalg.norm(dV[:, None] - self.known, axis=2).argmin(axis=1)
        places = np.where(np.abs(dV).max(axis=1) > 1e-4, self.places[nearest].T, np.nan).T
        return Predictions.from_arrays(len(dV), self.spec, places=places[:, None])

    def arrays(self):
        return {"known": self.known, "places": self.places}

    @classmethod
    def from_arrays(cls, arrays, spec, settings):
        assert settings.options == {"kept": 30}
        return cls(arrays["known"], arrays["places"], spec)


KEPT = TrainingSettings(options={"kept": 30}, method="any:name")


@pytest.fixture(scope="module")
def dataset():
    return frames()


@pytest.fixture(scope="module")
def pipeline(dataset):
    return Pipeline.fit(dataset, KEPT, method=Strongest)


@pytest.fixture(scope="module")
def folder(pipeline, tmp_path_factory):
    return pipeline.save(tmp_path_factory.mktemp("own") / "own.eitmodel")


def test_code_that_is_not_named_or_is_another_is_refused(folder, monkeypatch):
    """Opening runs no code that the user does not name."""
    other = type("Other", (Strongest,), {})
    for path, code, message in (
        (folder, None, r"runs no code on its own.*--method .*:Strongest"),
        (folder, other, r"by .*:Strongest, got the code of .*Other"),
        ("reference.eitmodel", Strongest, "ships with eitskin"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            Pipeline.load(path, code)
    monkeypatch.setattr(Strongest, "predict", shifted)
    with pytest.raises(DataError, match="does not compute"):
        Pipeline.load(folder, Strongest)
    monkeypatch.setattr(Strongest, "predict", lambda _self, _seen: 1 / 0)
    with pytest.raises(ConfigurationError, match=r"ZeroDivisionError.*line"):
        Pipeline.load(folder, Strongest)


def shifted(method, observations):
    places = np.full((len(observations), 1, 2), 0.03)
    return Predictions.from_arrays(len(observations), method.spec, places=places)


@pytest.mark.slow
def test_a_method_without_states_keeps_its_reference_while_touched(pipeline, dataset):
    """What is not estimated is None; a held touch does not become the reference."""
    idle = dataset.frame(0)
    row = int(np.flatnonzero((dataset.touch_count == 1) & (dataset.bend_angle_deg == 0))[0])
    pipeline.reset()
    pipeline.process(dataclasses.replace(idle, impedance=FLAT.astype(complex), number=0))
    for number in range(1, 40):
        frame = dataclasses.replace(dataset.frame(row), number=number, time=0.1 * number, session=0)
        held = pipeline.process(frame)
    assert len(held.touches) == 1
    assert held.state is held.bend_angle_deg is None
    assert np.isnan(held.probabilities).all()
    report = evaluate(pipeline, dataset)
    assert report.bend.rmse_deg is None
    assert not any(report.states.accuracy.values())
    pipeline.reset()


def says(**what):
    return lambda self, seen: Predictions.from_arrays(
        len(seen), self.spec, **{k: f(len(seen)) for k, f in what.items()}
    )


WRONG = {
    "shape": ({"predict": says(probabilities=lambda n: np.ones((n, 2)) / 2)}, "shape"),
    "states": ({"targets": Targets(angle=False, force=False)}, "probabilities"),
    "sum": (
        {
            "targets": Targets(angle=False, touches=False, force=False),
            "predict": says(probabilities=lambda n: np.ones((n, 3))),
        },
        "add up",
    ),
    "angle": ({"predict": says(bend_angle_deg=np.zeros)}, "bend angles"),
    "touches": ({"targets": Targets((), False, False, False)}, "touches, which"),
    "objects": ({"arrays": lambda _self: {"a": np.array([None])}}, "arrays of numbers"),
    "names": (
        {"arrays": lambda _self: {"layout.reference": np.zeros(3)}},
        "name that eitskin uses",
    ),
    "lost": ({"arrays": lambda self: {"known": self.known}}, "KeyError"),
    "other": (
        {"arrays": lambda self: {"known": self.known, "places": self.places + 0.01}},
        "restore",
    ),
}


@pytest.mark.parametrize(("members", "message"), WRONG.values(), ids=WRONG)
def test_a_method_that_is_wrong_is_refused_when_it_is_fitted(dataset, members, message):
    faulty = type("Strongest", (Strongest,), {"__module__": __name__, **members})
    with pytest.raises(MethodCodeError, match=message):
        Pipeline.fit(dataset, KEPT, method=faulty)


@pytest.mark.slow
def test_the_method_of_the_page_goes_through_the_commands(tmp_path):
    """Trained, evaluated and run live, as docs/how-to/own-method.md says."""
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    (tmp_path / "my.py").write_text(code)
    save_dataset(frames(600), tmp_path / "data")
    own, model = ("--method", f"{tmp_path / 'my.py'}:Net"), tmp_path / "my.eitmodel"
    trained = printed_json("train", tmp_path / "data", *own, "--set", "width=48", "--out", model)
    report = trained["metrics"]
    shares = [share for share in report["states"]["accuracy"].values() if share is not None]
    assert min(shares) > 0.9
    assert report["touches"]["1"]["mean_error_mm"] < 12
    assert report["bend"]["rmse_deg"] < 6
    assert report["force"] is None
    settings = json.loads((model / "pipeline.json").read_text())["settings"]
    assert settings["options"] == {"width": 48}
    assert printed_json("evaluate", model, tmp_path / "data", *own)["frames"] == 102
    live = run("live", model, "--board", f"replay:{tmp_path / 'data'}", "--json", *own)
    states = [json.loads(line)["state"] for line in live.stdout.splitlines()]
    assert states[:3] == ["idle", "touch", "bend"]
    with pytest.raises(ConfigurationError, match=r"--method my\.py:Net"):
        run("evaluate", model, tmp_path / "data")
    again = ("train", tmp_path / "data", *own, "--out", model, "--replace")
    with pytest.raises(ConfigurationError, match="leave one out"):
        run(*again, "--preset", "quick")
    with pytest.raises(ConfigurationError, match="NAME=VALUE"):
        run(*again, "--set", "width")


def test_the_old_name_of_adapt_serves_with_a_warning():
    with pytest.warns(DeprecationWarning, match="`adapt`"):

        class Old(Strongest):
            def adapted(self, known):
                return self, known

    old = Old([], [], None)
    assert old.adapts
    assert not Strongest([], [], None).adapts
    assert old.adapt(3) == (old, 3)
