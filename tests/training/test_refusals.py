"""Refusals of training: what was asked, the error, and the words that name the key or remedy."""

import dataclasses
import json
import math
from functools import partial

import numpy as np
import pytest
from known_frames import known_by_levels
from touched_dataset import touched_dataset

from eitskin.datasets import Dataset, State
from eitskin.errors import ConfigurationError, DataError, FrameError
from eitskin.geometry import Disc, Hinge, SensorDesign
from eitskin.simulator import Protocol, Scene, Touch
from eitskin.training import (
    FrameLabel,
    NetworkSettings,
    Pipeline,
    PixelGrid,
    Regularisation,
    StoredReference,
    TouchLabel,
    TrainingSettings,
    Twin,
    TwinPrior,
    Zero,
)
from eitskin.training.evaluation.cramer_rao import cramer_rao_bound, scene_derivatives
from eitskin.training.joint.frame_predictions import ErrorScale
from eitskin.training.method.known_frames import KnownFrames
from eitskin.training.method.targets import require_targets
from eitskin.training.paper.stages import BendAngle
from eitskin.training.pipeline.methods import MethodCodeError, method_class, named_method
from eitskin.training.pipeline.references import FORMAT_VERSION
from eitskin.training.reconstruction.pixel_grid import figures_of_merit
from eitskin.training.twin.labelled_frames import labelled_frames

from made_up_sensor import frames
from smooth_sensor import FLAT, LAYOUT, PROTOCOL

REST, BENT = FrameLabel(), FrameLabel(20.0)
FAR = FrameLabel(0.0, (TouchLabel(75.0, 30.0),))
SLOPES = np.random.default_rng(6).normal(size=(4, 9))
NOISE, ROWS = np.ones(9), np.ones((3, 128))
DEEP = Scene(touches=(Touch(0.03, 0.03, depth=1e-3),))
IDLE = touched_dataset(np.ones((3, 6)), np.ones(6), [[]] * 3, state=[State.IDLE] * 3)
ONLY_BENT = Dataset.from_arrays(
    np.ones((2, 64)), protocol=Protocol.adjacent(8, shared=True), bend_angle_deg=[10.0, 20.0]
)
GRID = PixelGrid.from_outline(Disc(0.1), 100)


def of_specimens(count, labels=None):
    """Known frames of a dataset of four."""
    data = touched_dataset(np.tile(FLAT, (4, 1)), FLAT, [[]] * 4, protocol=PROTOCOL)
    data = dataclasses.replace(
        data,
        reference=np.tile(data.reference, (count, 1)),
        specimen=np.arange(4) % count,
        specimen_number=np.arange(count),
    )
    return KnownFrames.from_frames(data, labels, LAYOUT)


def fit(name, **options):
    return Pipeline.fit(
        frames(24), dataclasses.replace(TrainingSettings.preset(name), options=options)
    )


class Narrow:
    """A simulator of touches of one force, or a little more or less."""

    def deformation(self, scene):
        if any(not 9.9 <= touch.force <= 10.1 for touch in scene.touches):
            raise ConfigurationError("off")


RULES = ("gcv:1", "snr", "snr:x", "snr:-1", "lambda:inf", "l-curve:1")
SCALES = ([1.0, math.nan], [1.0, -1.0], [1.0, 1.0, 1.0])
REFUSALS = {
    ConfigurationError: [
        (lambda: known_by_levels([REST], [0, 0]), "1 labels and 2 frames"),
        (lambda: known_by_levels([BENT, BENT], [0, 0]), "record the flat sensor"),
        (lambda: of_specimens(2), "2 specimens"),
        (lambda: of_specimens(1, [REST]), "no labels beside"),
        (lambda: NetworkSettings(0.0, epochs=1), "learning_rate"),
        (lambda: TrainingSettings.preset("best"), "best"),
        (lambda: fit("mlp", widht=3), "widht"),
        (lambda: fit("mlp", width=0), "width of 1"),
        (lambda: fit("ridge", epochs=3), "epochs"),
        (lambda: fit("greit", trees=3), "no options"),
        (lambda: cramer_rao_bound(SLOPES[[0, 0]], NOISE), "separately"),
        (
            lambda: cramer_rao_bound(SLOPES * [[1.0], [0.0], [1.0], [1.0]], NOISE),
            r"parameters \[1\]",
        ),
        (lambda: cramer_rao_bound([SLOPES[0], SLOPES[1], -3.0 * SLOPES[0]], NOISE), r"\[0, 2\]"),
        (
            lambda: scene_derivatives(Narrow(), Scene(touches=(Touch(0.03, 0.03, 10.0),))),
            r"force of touch 0 .*0\.2",
        ),
        (lambda: scene_derivatives(Narrow(), DEEP), "give a force"),
        (lambda: labelled_frames(dataclasses.replace(ONLY_BENT, protocol=None)), "protocol"),
        (lambda: Twin.fit(SensorDesign.reference(), ONLY_BENT, fixture=Hinge()), "give a clamp"),
        (lambda: TwinPrior(thickness=0.1), "thickness"),
        *((partial(Regularisation.from_text, text), "expected a rule") for text in RULES),
    ],
    DataError: [
        (lambda: known_by_levels([REST, FAR], [0, 0]), "places are in metres"),
        (lambda: FrameLabel(math.inf), "angle up to 360"),
        (lambda: TouchLabel(0.1, 0.03, 0.0), "above 0 N"),
        (lambda: TouchLabel(math.nan, 0.03), "position"),
        (lambda: require_targets(IDLE), "3 idle, 0 touch"),
        (lambda: BendAngle.fit(ROWS, np.arange(3.0), np.zeros(3)), "at least 10 frames"),
        (lambda: figures_of_merit(np.zeros(len(GRID)), GRID, (0.1, 0.1), 1.0), "got none"),
        (lambda: labelled_frames(ONLY_BENT), "flat"),
        *((partial(ErrorScale.from_stored, np.array(x)), "standard errors") for x in SCALES),
        *(
            (partial(method_class, kind), "MODULE:CLASS")
            for kind in ("m:M;ls", "m\n:M", ":M", "m:")
        ),
    ],
    FrameError: [
        (lambda: known_by_levels([REST, BENT], [3.0, 3.1]), "times those"),
    ],
    MethodCodeError: [
        (lambda: method_class("$(id):M"), r"--method '\$\(id\)\.py:M' "),
        (lambda: named_method("none.py:Net"), "no file"),
        (lambda: named_method("Net"), r"FILE\.py:CLASS or an installed method \(none"),
    ],
}


@pytest.mark.parametrize(
    ("error", "ask", "says"), [(error, *row) for error, rows in REFUSALS.items() for row in rows]
)
def test_what_cannot_be_is_refused_with_what_to_do(error, ask, says):
    with pytest.raises(error, match=says):
        ask()


METHODS = {
    "class Other: pass": "no class 'Net'; it has Other",
    "Net = 3": "derived from eitskin.training.Method, got 3",
    "def Net(:": r"SyntaxError.*my\.py, line 1",
    "\nimport not_there": r"ModuleNotFoundError.*line 2",
    "from eitskin.training import Method\nclass Net(Method): pass": "lacks arrays, fit, fro",
}


@pytest.mark.parametrize(("text", "says"), METHODS.items())
def test_code_that_is_no_method_is_told(tmp_path, text, says):
    (tmp_path / "my.py").write_text(text)
    with pytest.raises(MethodCodeError, match=says):
        named_method(f"{tmp_path / 'my.py'}:Net")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"format": "other"}, "is no reference"),
        ({"format_version": FORMAT_VERSION + 1}, "newer eitskin"),
        ({"real": [1.0]}, "expected 28 real"),
        ({"real": [None] * 28}, "good channel"),
        ({"zero": "bent"}, "bent"),
        ({"zero": "first read_frames"}, "expected 'flat'"),
        ({"taken": "yesterday"}, "yesterday"),
        ({"frames": 0}, "positive"),
        ({"colour": 1}, "colour"),
        ("whole", "no whole reference"),
        ("none", "eitskin tare"),
    ],
)
def test_files_that_are_no_reference_are_refused(tmp_path, change, says):
    values = np.outer([1.0, 1.001, 0.999], FLAT) + 0j
    path = StoredReference.from_frames(values, PROTOCOL, 40e3, Zero.FLAT).write(tmp_path / "r.json")
    if change == "none":
        path.unlink()
    else:
        text = path.read_text()
        path.write_text(text[:20] if change == "whole" else json.dumps(json.loads(text) | change))
    with pytest.raises(DataError, match=says):
        StoredReference.read(path)
