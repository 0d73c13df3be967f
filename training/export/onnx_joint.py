"""The networks of the joint method as ONNX graphs; the Gauss-Newton fit is not a graph."""

import numpy as np
from numpy.typing import NDArray

from eitskin.training.export.onnx_graph import ExportedGraph, Value, relative_difference
from eitskin.training.export.onnx_paper import AXES, FRAME_UNITS, frames_as_inputs
from eitskin.training.joint.method import JointMethod
from eitskin.training.joint.proposal_model import network_inputs
from eitskin.training.method.observations import Observations

Array = NDArray[np.float64]

PROPOSALS = (
    "Initial guesses of the touches in n frames without bad channels, as a map of cells; the fit "
    "starts from the cells of largest value."
)
PROPOSAL_UNITS = {
    **FRAME_UNITS,
    "angle_deg": "degree; of the dynamic reference",
    "cells": f"0 to 1; {AXES}",
}
RESPONSE = (
    "Change of log V by each of n single touches, on the specimen with these flat resistances; "
    "changes of touches on one specimen add up."
)
RESPONSE_UNITS = {
    "touches": "x [m], y [m], force [N]",
    "angle_deg": "degree",
    "flat_magnitude": "ohm; of the flat, untouched specimen",
    "change": "of log V, dimensionless",
}
NOT_IN_GRAPH = (
    "the Gauss-Newton fit of angle and touches with its evidence, standard errors and faults: its "
    "number of steps and touches depends on the frame",
    "the angle of the dynamic reference, which that fit gives and proposals take",
    "the references themselves, which a session renews while nothing touches the sensor",
    "touch_map, which is drawn from the touches that were found",
)
CHECKED = 96  # touches that check the response, over position, force, angle and specimen
ANGLE_SCALE = 30.0  # deg, which both networks take as one


def proposals_graph(method: JointMethod, frames: Observations) -> ExportedGraph:
    """`network_inputs` and `ProposalNetwork.map`; checked on `frames` over the range of angles."""
    stage, noise = method.proposals, np.sqrt(2.0) * method.combinations.unit

    def build(
        impedance: Value, static_reference: Value, dynamic_reference: Value, angle_deg: Value
    ) -> list[Value]:
        change = (relative_difference(impedance, dynamic_reference) + 1.0).op("Log")
        change = change @ method.combinations.matrix.T
        sizes = (change / (2.0 * noise)).cast("float").op("Asinh")
        flat = (static_reference * static_reference).sum(2).op("Sqrt")
        context = _angle(angle_deg).op("Concat", _features(method, flat), axis=1).cast("float")
        value = sizes.op("Concat", context, axis=1)
        for weight, bias in zip(stage.weights[:-1], stage.biases[:-1], strict=True):
            value = value.dense(weight, bias).silu()
        logits = value.dense(stage.weights[-1], stage.biases[-1])
        shape = (len(stage.rows), len(stage.columns))
        return [logits.op("Sigmoid").op("Reshape", [-1, *shape])]

    angles = np.linspace(*method.bend_prior.angle_deg, len(frames))
    features = method.features.apply(frames.flat)
    change = method.combinations.of(np.log1p(frames.dynamic))
    inputs = network_inputs(change, noise, angles, features)
    cells = np.array([stage.map(each) for each in inputs], dtype=np.float32)
    feeds = {**frames_as_inputs(frames), "angle_deg": angles}
    return ExportedGraph.of("proposals", PROPOSALS, build, feeds, {"cells": cells}, PROPOSAL_UNITS)


def response_graph(method: JointMethod, frames: Observations) -> ExportedGraph:
    """`SpecimenResponse` of one touch; checked on the specimens of `frames`."""
    stage = method.response
    terms, channels, hidden = stage.output.shape
    output = stage.output.reshape(terms * channels, hidden)  # its last column multiplies 1

    def build(touches: Value, angle_deg: Value, flat_magnitude: Value) -> list[Value]:
        position = touches * stage.ranges.input_scale - 1.0
        value = position.op("Concat", _angle(angle_deg), axis=1).cast("float")
        for weight, bias in zip(stage.weights, stage.biases, strict=True):
            value = value.dense(weight, bias).silu()
        each = value.dense(output[:, :-1], output[:, -1]).op("Reshape", [-1, terms, channels])
        features = _features(method, flat_magnitude).cast("float")
        identity = np.eye(terms)
        shares = features.dense(identity[:, 1:], identity[0])  # [1, features]
        change = (each * shares.op("Reshape", [-1, terms, 1])).sum(1).cast("double")
        force = touches.op("Gather", [2], axis=1)
        scaled = change * (force * (stage.scale / stage.ranges.middle_force))
        return [scaled @ method.combinations.changes(np.eye(channels))]

    feeds = _touches_to_check(method, frames)
    changes = [
        stage.of(method.features.apply(flat))(touch[None], angle)[0]
        for touch, angle, flat in zip(*feeds.values(), strict=True)
    ]
    expected = {"change": method.combinations.changes(np.array(changes))}
    return ExportedGraph.of("response", RESPONSE, build, feeds, expected, RESPONSE_UNITS)


def _angle(angle_deg: Value) -> Value:
    """Angles (n,) [deg] as a column, in units of `ANGLE_SCALE`."""
    return angle_deg.op("Reshape", [-1, 1]) / ANGLE_SCALE


def _features(method: JointMethod, flat: Value) -> Value:
    """Features (n, P) of flat magnitudes (n, C), as `SpecimenFeatures.apply`."""
    logs = flat.op("Log") - method.features.middle
    return (logs - logs.op("ReduceMean", axes=[1], keepdims=1)) @ method.features.directions.T


def _touches_to_check(method: JointMethod, frames: Observations) -> dict[str, Array]:
    """Touches over the learned positions, forces and angles, on the specimens of the frames."""
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
