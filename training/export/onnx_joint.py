"""The networks of the joint method as ONNX graphs; the fit that uses them is no graph."""

import numpy as np
from numpy.typing import NDArray

from eitskin.training.export.onnx_graph import ExportedGraph, GraphBuilder, N, Port
from eitskin.training.export.onnx_paper import declared_frames, frames_as_inputs
from eitskin.training.joint.method import JointMethod
from eitskin.training.joint.proposal_model import network_inputs
from eitskin.training.method.input_spec import Layout
from eitskin.training.method.observations import Observed

Array = NDArray[np.float64]

PROPOSALS = (
    "Where touches may be, at first glance, of n frames without bad channels; the fit starts from "
    "the cells of largest value."
)
RESPONSE = (
    "The change of log V by each of n touches alone, on the specimen with these flat resistances; "
    "changes of touches on one specimen add up."
)
NOT_IN_GRAPH = (
    "the Gauss-Newton fit of angle and touches with its evidence, standard errors and faults: its "
    "number of steps and touches depends on the frame",
    "the angle of the dynamic reference, which that fit gives and proposals take",
    "the references themselves, which a session renews while nothing touches the sensor",
    "touch_map, which is drawn from the touches that were found",
)
CHECKED = 96  # touches that the response is checked with, over place, force, angle and specimen


def proposals_graph(method: JointMethod, layout: Layout, frames: Observed) -> ExportedGraph:
    """The graph of `network_inputs` and `Proposals.map`."""
    graph, stage = GraphBuilder(), method.proposals
    impedance, flat, free = declared_frames(graph, layout)
    angle = graph.input(Port("angle_deg", (N,), "double", "degree; of the dynamic reference"))
    dynamic = graph.relative_difference(impedance, free)
    change = graph.add("Log", graph.add("Add", dynamic, graph.constant(1.0)))
    units = graph.constant(2.0 * np.sqrt(2.0) * method.noise)
    sizes = graph.add("Asinh", graph.cast(graph.add("Div", change, units), "float"))
    axis = graph.integers(2)
    square = graph.add("ReduceSum", graph.add("Mul", flat, flat), axis, keepdims=0)
    features = _features(graph, method, graph.add("Sqrt", square))
    bent = graph.add("Div", graph.reshaped(angle, -1, 1), graph.constant(30.0))
    rest = [graph.cast(value, "float") for value in (bent, features)]
    value = graph.add("Concat", sizes, *rest, axis=1)
    for weight, bias in zip(stage.weights[:-1], stage.biases[:-1], strict=True):
        value = graph.silu(graph.dense(value, weight, bias))
    logits = graph.dense(value, stage.weights[-1], stage.biases[-1])
    shape = (len(stage.rows), len(stage.columns))
    cells = graph.reshaped(graph.add("Sigmoid", logits), -1, *shape)
    graph.output(
        Port("cells", (N, *shape), "float", "0 to 1; rows along y, columns along x"), cells
    )
    low, high = method.curves.angle_deg
    angles = np.linspace(low, high, len(frames))
    inputs = network_inputs(
        np.log1p(frames.dynamic),
        np.sqrt(2.0) * method.noise,
        angles,
        method.features.apply(frames.flat),
    )
    return ExportedGraph(
        "proposals",
        PROPOSALS,
        tuple(graph.inputs),
        tuple(graph.outputs),
        graph.model("eitskin_proposals", PROPOSALS),
        {**frames_as_inputs(frames), "angle_deg": angles},
        {"cells": np.array([stage.map(each) for each in inputs])},
    )


def response_graph(method: JointMethod, layout: Layout, frames: Observed) -> ExportedGraph:
    """The graph of `SpecimenResponse`."""
    graph, stage = GraphBuilder(), method.response
    channels, ranges = len(layout.protocol), stage.ranges
    touches = graph.input(Port("touches", (N, 3), "double", "x [m], y [m], force [N]"))
    angle = graph.input(Port("angle_deg", (N,), "double", "degree"))
    flat = graph.input(
        Port("flat_magnitude", (N, channels), "double", "ohm; of the flat, untouched specimen")
    )
    scale = graph.constant(ranges.input_scale)
    place = graph.add("Sub", graph.add("Mul", touches, scale), graph.constant(1.0))
    bent = graph.add("Div", graph.reshaped(angle, -1, 1), graph.constant(30.0))
    value = graph.cast(graph.add("Concat", place, bent, axis=1), "float")
    for weight, bias in zip(stage.weights, stage.biases, strict=True):
        value = graph.silu(graph.dense(value, weight, bias))
    terms, _, hidden = stage.output.shape
    # (1 + P, C, hidden + 1): what multiplies [h, 1], for the middle specimen and each feature.
    output = stage.output.reshape(terms * channels, hidden)
    each = graph.reshaped(graph.dense(value, output[:, :-1], output[:, -1]), -1, terms, channels)
    features = graph.cast(_features(graph, method, flat), "float")
    identity = np.eye(terms)
    shares = graph.dense(features, identity[:, 1:], identity[0])  # [1, features]
    share = graph.reshaped(shares, -1, terms, 1)
    summed = graph.add("ReduceSum", graph.add("Mul", each, share), graph.integers(1), keepdims=0)
    force = graph.add("Gather", touches, graph.integers(2), axis=1)
    factor = graph.add("Mul", force, graph.constant(stage.scale / ranges.middle_force))
    change = graph.add("Mul", graph.cast(summed, "double"), factor)
    graph.output(Port("change", (N, channels), "double", "of log V, dimensionless"), change)
    feeds = _touches_to_check(method, frames)
    expected = [
        stage.of(method.features.apply(z))(touch[None], theta)[0]
        for touch, theta, z in zip(*feeds.values(), strict=True)
    ]
    return ExportedGraph(
        "response",
        RESPONSE,
        tuple(graph.inputs),
        tuple(graph.outputs),
        graph.model("eitskin_response", RESPONSE),
        feeds,
        {"change": np.array(expected)},
    )


def _features(graph: GraphBuilder, method: JointMethod, flat: str) -> str:
    """Features (n, P) of flat magnitudes (n, C), as `SpecimenFeatures.apply`."""
    logs = graph.add("Sub", graph.add("Log", flat), graph.constant(method.features.middle))
    common = graph.add("ReduceMean", logs, axes=[1], keepdims=1)
    departure = graph.add("Sub", logs, common)
    return graph.add("MatMul", departure, graph.constant(method.features.directions.T))


def _touches_to_check(method: JointMethod, frames: Observed) -> dict[str, Array]:
    """Touches over all that the response was learned for, on the specimens of the frames."""
    ranges = method.response.ranges
    chosen = np.linspace(0, len(method.places) - 1, CHECKED).astype(int)
    force, angle = (
        np.resize(np.linspace(*ends, steps), CHECKED)
        for ends, steps in ((ranges.force, 5), (ranges.angle_deg, 7))
    )
    return {
        "touches": np.column_stack([method.places[chosen], force]),
        "angle_deg": angle,
        "flat_magnitude": np.resize(frames.flat, (CHECKED, frames.flat.shape[1])),
    }


GRAPHS = (proposals_graph, response_graph)
