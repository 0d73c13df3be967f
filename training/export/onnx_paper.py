"""The paper's method as one ONNX graph, from a frame and its two references to the estimates."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.state import State
from eitskin.training.export.onnx_graph import (
    ExportedGraph,
    Value,
    network,
    relative_difference,
)
from eitskin.training.method.observations import Observations
from eitskin.training.paper.bend_angle import BendAngle
from eitskin.training.paper.classifier import Classifier
from eitskin.training.paper.layers import coordinates
from eitskin.training.paper.method import PaperMethod
from eitskin.training.paper.postprocessor import PostProcessor

WHAT = (
    "The whole of the paper's method for n frames without bad channels: state, bend angle and "
    "touch map, each from a frame and its two references."
)
NOT_IN_GRAPH = (
    "the references themselves, which a session renews while nothing touches the sensor",
    "bad channels, which are first replaced by a conditional mean (MissingChannels.fill)",
    "positions of touches, the centroids of connected components of touch_map above 0.4 "
    "(find_touches)",
)
IMPEDANCE = "ohm; frames, measurements in the order of the table, real and imaginary part"
FRAME_UNITS = dict.fromkeys(("impedance", "static_reference", "dynamic_reference"), IMPEDANCE)
AXES = "rows along y, columns along x"
UNITS = {
    **FRAME_UNITS,
    "probabilities": "of idle, touch, bend",
    "state": "0 idle, 1 touch, 2 bend",
    "bend_angle_deg": "degree",
    "touch_map": f"probability, 0 to 1; {AXES}",
    "static_picture": f"relative change; {AXES}",
    "dynamic_picture": f"relative change; {AXES}",
}
PHASE = np.exp(0.1j)  # of the impedances that check the graph; it cancels in relative differences


def paper_graph(method: PaperMethod, frames: Observations) -> ExportedGraph:
    """`PaperMethod.predict` without centroids, and the reconstructions; checked on `frames`."""

    def build(impedance: Value, static_reference: Value, dynamic_reference: Value) -> list[Value]:
        static = relative_difference(impedance, static_reference)
        dynamic = relative_difference(impedance, dynamic_reference)
        pictures = [_picture(method, difference) for difference in (static, dynamic)]
        shape = method.reconstruction.shape
        outputs: list[Value] = []
        touched: Value | None = None
        if method.classifier:
            probabilities = _probabilities(method.classifier, static)
            number = probabilities.op("ArgMax", axis=1, keepdims=0)
            states = np.array(method.classifier.states, dtype=np.int64)
            state = static.graph.node("Gather", states, number, axis=0)
            outputs, touched = [probabilities, state], state.op("Equal", np.int64(State.TOUCH))
        if method.bend_angle:
            outputs.append(_angle(method.bend_angle, static, dynamic, touched))
        if method.postprocessor and touched:
            outputs.append(_touch_map(method.postprocessor, pictures[1], shape, touched))
        return [*outputs, *pictures]

    predictions, targets = method.predict(frames), method.targets
    reconstruct = method.reconstruction.apply
    expected: dict[str, NDArray[Any]] = {}
    if method.classifier:
        expected["probabilities"] = predictions.probabilities[:, method.classifier.states]
        expected["state"] = predictions.state.astype(np.int64)
    if targets.angle:
        expected["bend_angle_deg"] = predictions.bend_angle_deg
    if targets.touches:
        expected["touch_map"] = predictions.touch_map
    expected["static_picture"] = reconstruct(frames.static)
    expected["dynamic_picture"] = reconstruct(frames.dynamic)
    units = UNITS | {"probabilities": f"of {', '.join(targets.states)}"}
    return ExportedGraph.of("paper", WHAT, build, frames_as_inputs(frames), expected, units)


def frames_as_inputs(frames: Observations) -> dict[str, NDArray[np.float64]]:
    """Impedances and references (n, C, 2) [ohm] whose relative differences are `frames`."""
    flat = frames.flat * PHASE
    impedance = flat * (1.0 + frames.static)
    dynamic = impedance / (1.0 + frames.dynamic)
    parts = (np.stack([z.real, z.imag], axis=-1) for z in (impedance, flat, dynamic))
    return dict(zip(FRAME_UNITS, parts, strict=True))


def _probabilities(stage: Classifier, static: Value) -> Value:
    """Probabilities (n, states) of the states that were trained for."""
    maps, pixels, channels = stage.embedding.shape
    embedded = static @ stage.embedding.reshape(maps * pixels, channels).T
    value = embedded.op("Reshape", [-1, maps, *stage.shape]).cast("float")
    value = value.op("Asinh") if stage.compress else value
    logits = network(stage.layers, value).cast("double")
    states = np.array(stage.states, dtype=np.int64)
    return logits.op("Gather", states, axis=1).op("Softmax", axis=1)


def _angle(stage: BendAngle, static: Value, dynamic: Value, touched: Value | None) -> Value:
    """The angle of a touched frame is that of its dynamic reference."""
    difference = static
    if touched:
        reference = (static + 1.0) / (dynamic + 1.0) - 1.0
        difference = touched.op("Unsqueeze", [1]).op("Where", reference, static)
    features = difference.op("Concat", difference * difference, axis=1)
    return features.op("Gather", stage.features, axis=1) @ stage.coefficients + stage.intercept


def _picture(method: PaperMethod, difference: Value) -> Value:
    stage = method.reconstruction
    return (difference @ stage.matrix.T).op("Reshape", [-1, *stage.shape])


def _touch_map(
    stage: PostProcessor, picture: Value, shape: tuple[int, int], touched: Value
) -> Value:
    """Zero where a frame is not touched."""
    maps = (picture / stage.scale).op("Reshape", [-1, 1, *shape]).cast("float")
    size = maps.op("Shape", start=0, end=1).op("Concat", [2, *shape], axis=0)
    place = maps.graph.node("Expand", coordinates(shape)[None], size)
    logits = network(stage.layers, maps.op("Concat", place, axis=1))
    values = logits.op("Reshape", [-1, *shape]).op("Sigmoid")
    return touched.op("Unsqueeze", [1, 2]).op("Where", values, np.float32(0.0))
