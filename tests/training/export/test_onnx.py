"""Pipelines as ONNX: what onnxruntime makes of the graphs is what the pipeline makes."""

import dataclasses
import hashlib
import json
import sys

import numpy as np
import onnx
import pytest
import torch
from torch import nn
from typer.testing import CliRunner

from eitskin.cli.main import app
from eitskin.datasets import State
from eitskin.errors import ConfigurationError, DataError
from eitskin.geometry import SensorDesign
from eitskin.simulator import Protocol
from eitskin.training import Pipeline, TrainingSettings
from eitskin.training.export.onnx_export import DOCUMENT, checked, export_onnx, graphs_of, run_graph
from eitskin.training.export.onnx_graph import OPSET
from eitskin.training.export.onnx_paper import frames_as_inputs
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.method.missing_channels import MissingChannels
from eitskin.training.method.network_training import seeded_network
from eitskin.training.method.observations import Observations, relative_difference
from eitskin.training.paper.bend_angle import BendAngle
from eitskin.training.paper.classifier import Classifier
from eitskin.training.paper.method import PaperMethod
from eitskin.training.paper.networks import StateNetwork, TouchMapNetwork, weights_of
from eitskin.training.paper.postprocessor import PostProcessor
from eitskin.training.paper.reconstruction import Reconstruction

FRAMES, CHANNELS, SHAPE = 40, 28, (32, 80)


def stirred(module):
    """A network whose batch statistics are not those it begins with, in evaluation mode."""
    torch.manual_seed(1)
    for layer in module.modules():
        if isinstance(layer, nn.BatchNorm2d):
            layer.running_mean.normal_(0.0, 0.3)
            layer.running_var.uniform_(0.5, 2.0)
            layer.weight.data.uniform_(0.5, 1.5)
            layer.bias.data.normal_(0.0, 0.3)
    return module.eval()


def observations(rng):
    dV = 0.02 * rng.standard_normal((2, FRAMES, CHANNELS))
    flat = rng.uniform(300, 800, (FRAMES, CHANNELS))
    ones = np.ones(FRAMES)
    return Observations(dV[0], dV[1], flat, ones, ones, ones, ones, ones)


@pytest.fixture(scope="module")
def paper() -> Pipeline:
    """The paper's stages with weights that were drawn, which take no time to train."""
    rng = np.random.default_rng(3)
    frames = observations(rng)
    reconstruction = Reconstruction(
        rng.standard_normal((SHAPE[0] * SHAPE[1], CHANNELS)), SHAPE, 0.1
    )
    with torch.random.fork_rng(devices=[]):
        state = stirred(seeded_network(lambda: StateNetwork(SHAPE, 2), 0))
        maps = stirred(seeded_network(lambda: TouchMapNetwork(SHAPE), 0))
    state.layers[-1].weight.data *= 30.0  # so that frames differ in their state, and maps vary
    maps.layers[-1].weight.data *= 20.0
    embedding = 200.0 * rng.standard_normal((2, SHAPE[0] * SHAPE[1], CHANNELS))
    logits = np.log(Classifier(weights_of(state), embedding, SHAPE, True).apply(frames.static))
    state.layers[-1].bias.data -= torch.as_tensor(logits.mean(axis=0), dtype=torch.float32)
    method = PaperMethod(
        reconstruction,
        Classifier(weights_of(state), embedding, SHAPE, compress=True),
        BendAngle(np.array([1, 5, 30, 55]), 100.0 * rng.standard_normal(4), -2.0),
        PostProcessor(weights_of(maps), 0.14),
        MissingChannels(np.eye(CHANNELS)),
        MissingChannels(np.eye(CHANNELS)),
        (0.150, 0.060),
    )
    layout = InputSpec(SensorDesign.reference(), Protocol.pairwise(8), 40e3, frames.flat[0])
    return Pipeline(layout, method, 1e-3, TrainingSettings(), {"source": "drawn"}, frames)


@pytest.fixture(scope="module")
def joint() -> Pipeline:
    return Pipeline.load("reference.eitmodel")


# Equality


@pytest.mark.slow
def test_the_paper_graph_gives_what_the_method_gives(paper) -> None:
    (graph,), _ = graphs_of(paper)
    said = run_graph(graph.model, graph.feeds)
    known = paper.method.predict(paper.examples)
    assert {State.TOUCH, State.BEND} <= set(known.state.tolist())  # both ways through the graph
    assert np.array_equal(said["state"], known.state)
    assert said["probabilities"] == pytest.approx(known.probabilities, abs=1e-6)
    assert said["bend_angle_deg"] == pytest.approx(known.bend_angle_deg, rel=1e-10)
    assert np.abs(said["touch_map"] - known.touch_map).max() < 1e-5
    touched = known.state == State.TOUCH
    assert said["touch_map"][~touched].max() == 0.0
    assert np.ptp(said["touch_map"][touched]) > 0.1
    for name, picture in zip(
        ("static", "dynamic"), paper.method.reconstructions(paper.examples), strict=True
    ):
        assert np.abs(said[f"{name}_picture"] - picture).max() < 1e-6 * np.abs(picture).max()


def test_the_inputs_are_impedances_of_which_the_frames_are_the_differences(paper) -> None:
    inputs = {
        name: pair[..., 0] + 1j * pair[..., 1]
        for name, pair in frames_as_inputs(paper.examples).items()
    }
    V, flat, free = (inputs[f] for f in ("impedance", "static_reference", "dynamic_reference"))
    assert np.abs(flat.imag).min() > 1.0  # complex indeed
    assert relative_difference(V, flat) == pytest.approx(paper.examples.static, abs=1e-12)
    assert relative_difference(V, free) == pytest.approx(paper.examples.dynamic, abs=1e-12)


def test_one_frame_gives_what_it_gives_among_others(paper) -> None:
    (graph,), _ = graphs_of(paper)
    together = run_graph(graph.model, graph.feeds)
    alone = run_graph(graph.model, {name: array[7:8] for name, array in graph.feeds.items()})
    for name, values in alone.items():
        whole = together[name]
        assert np.abs(values - whole[7:8]).max() < 1e-6 * np.abs(whole).max(), name


def test_a_classifier_of_one_map_that_does_not_compress_is_exported_too(paper) -> None:
    stage = paper.method.classifier
    one_map = stirred(seeded_network(lambda: StateNetwork(SHAPE, 1), 5))
    plain = Classifier(weights_of(one_map), stage.embedding[:1] / 200.0, SHAPE, compress=False)
    method = dataclasses.replace(paper.method, classifier=plain)
    (graph,), _ = graphs_of(dataclasses.replace(paper, method=method))
    assert checked(graph)["probabilities"] < 1e-6
    assert graph.expected["probabilities"] == pytest.approx(plain.apply(paper.examples.static))


def test_the_joint_graphs_give_what_the_method_gives(joint) -> None:
    graphs, left_out = graphs_of(joint)
    assert [graph.name for graph in graphs] == ["proposals", "response"]
    assert "Gauss-Newton" in left_out[0]
    for graph in graphs:
        (difference,) = checked(graph).values()
        (expected,) = graph.expected.values()
        assert difference < 1e-6
        assert np.abs(expected).max() > 0.01
        assert np.ptp(expected, axis=0).max() > 0.01  # rows differ: batches are not mixed up


def test_the_response_is_that_of_a_touch_by_itself(joint) -> None:
    graph = graphs_of(joint)[0][1]
    method, flat = joint.method, joint.layout.reference
    touch = np.array([[0.04, 0.03, 8.0]])
    feeds = {"touches": touch, "angle_deg": np.array([20.0]), "flat_magnitude": flat[None]}
    said = run_graph(graph.model, feeds)["change"]
    known = method.response.of(method.features.apply(flat))(touch, 20.0)
    assert said == pytest.approx(known, rel=1e-4, abs=1e-7)


# Refusals


def test_a_graph_that_differs_is_refused_and_nothing_is_written(joint, tmp_path) -> None:
    graph = graphs_of(joint)[0][1]
    wrong = {name: values * (1 + 3e-5) for name, values in graph.expected.items()}
    with pytest.raises(DataError, match="'change' differs by"):
        checked(dataclasses.replace(graph, expected=wrong))
    with pytest.raises(DataError, match="nothing is written"):
        export_onnx(joint, tmp_path / "out", tolerance=1e-12)
    assert not (tmp_path / "out").exists()


def test_values_that_are_no_numbers_are_refused(joint) -> None:
    graph = graphs_of(joint)[0][1]
    feeds = {**graph.feeds, "touches": np.full_like(graph.feeds["touches"], np.nan)}
    with pytest.raises(DataError, match="differs by nan"):
        checked(dataclasses.replace(graph, feeds=feeds))


def test_golden_frames_with_bad_channels_are_left_out_and_some_must_be_whole(paper) -> None:
    static = paper.examples.static.copy()
    static[1:, 3] = np.nan
    frames = dataclasses.replace(paper.examples, static=static)
    (graph,), _ = graphs_of(dataclasses.replace(paper, examples=frames))
    assert len(graph.feeds["impedance"]) == 1
    static[0, 3] = np.nan
    with pytest.raises(DataError, match="golden frame"):
        graphs_of(dataclasses.replace(paper, examples=frames))


@pytest.mark.parametrize("module", ["onnx", "onnxruntime"])
def test_the_missing_extra_is_named(joint, module, monkeypatch, tmp_path) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=r"eitskin\[onnx\]"):
        export_onnx(joint, tmp_path)
    assert not list(tmp_path.iterdir())


# Files


def test_the_command_writes_graphs_and_a_page_that_says_what_they_take(tmp_path) -> None:
    out = tmp_path / "graphs"
    words = ["export", "onnx", "reference.eitmodel", "--out", str(out)]
    ran = CliRunner().invoke(app, [*words, "--json", "-q"])
    assert ran.exit_code == 0, ran.output
    document = json.loads((out / DOCUMENT).read_text())
    assert json.loads(ran.stdout) == document
    assert sorted(p.name for p in out.iterdir()) == [DOCUMENT, "proposals.onnx", "response.onnx"]
    for entry in document["graphs"]:
        content = (out / entry["file"]).read_bytes()
        assert hashlib.sha256(content).hexdigest() == entry["sha256"]
        model = onnx.load_from_string(content)
        assert [opset.version for opset in model.opset_import] == [OPSET] == [document["opset"]]
        assert [port["name"] for port in entry["inputs"]] == [i.name for i in model.graph.input]
        assert [port["name"] for port in entry["outputs"]] == [o.name for o in model.graph.output]
        assert all(port["unit"] for port in entry["inputs"] + entry["outputs"])
        for port in entry["outputs"]:
            assert 0.0 <= port["largest_difference"] <= port["allowed_difference"]
    assert isinstance(CliRunner().invoke(app, words).exception, ConfigurationError)


@pytest.mark.slow
def test_the_same_pipeline_gives_the_same_bytes(paper, tmp_path) -> None:
    first, second = (export_onnx(paper, tmp_path / name) for name in ("a", "b"))
    assert [g["sha256"] for g in first["graphs"]] == [g["sha256"] for g in second["graphs"]]
    assert first["not_in_graphs"]
    assert (tmp_path / "a" / "paper.onnx").stat().st_size == first["graphs"][0]["bytes"]
