"""The paper's method as one ONNX graph: from a frame and its two references to what it shows."""

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.state import State
from eitskin.training.export.onnx_graph import ExportedGraph, GraphBuilder, N, Port
from eitskin.training.method.input_spec import Layout
from eitskin.training.method.observations import Observed
from eitskin.training.paper.method import PaperMethod
from eitskin.training.paper.postprocessor import PostProcessor

WHAT = (
    "The whole of the paper's method for n frames without bad channels: state, bend angle and "
    "touch map, each from a frame and its two references."
)
NOT_IN_GRAPH = (
    "the references themselves, which a session renews while nothing touches the sensor",
    "bad channels, which are filled in before by a conditional mean (MissingChannels.fill)",
    "places of touches, which are regions of touch_map above 0.4 (find_touches)",
)
PHASE = np.exp(0.1j)  # of what the graph is checked with; a phase that V and ref share cancels


def paper_graph(method: PaperMethod, layout: Layout, frames: Observed) -> ExportedGraph:
    """The graph of `PaperMethod.perceive`, and of the pictures it is made of."""
    graph, (rows, columns) = GraphBuilder(), method.reconstruction.shape
    impedance, flat, free = declared_frames(graph, layout)
    static = graph.relative_difference(impedance, flat)
    dynamic = graph.relative_difference(impedance, free)
    probabilities = _classified(graph, method, static)
    state = graph.add("ArgMax", probabilities, axis=1, keepdims=0)
    touched = graph.add("Equal", state, graph.constant(State.TOUCH, np.int64))
    angle = _angle(graph, method, static, dynamic, touched)
    pictures = [_picture(graph, method, difference) for difference in (static, dynamic)]
    map_ = _touch_map(graph, method.postprocessor, pictures[1], touched, (rows, columns))
    map_shape, axes = (N, rows, columns), "rows along y, columns along x"
    for port, value in (
        (Port("probabilities", (N, 3), "double", "of idle, touch, bend"), probabilities),
        (Port("state", (N,), "int64", "0 idle, 1 touch, 2 bend"), state),
        (Port("bend_angle_deg", (N,), "double", "degree"), angle),
        (Port("touch_map", map_shape, "float", f"probability, 0 to 1; {axes}"), map_),
        (Port("static_picture", map_shape, "double", f"relative change; {axes}"), pictures[0]),
        (Port("dynamic_picture", map_shape, "double", f"relative change; {axes}"), pictures[1]),
    ):
        graph.output(port, value)
    said = method.perceive(frames)
    static_picture, dynamic_picture = (
        method.reconstruction.apply(each) for each in (frames.static, frames.dynamic)
    )
    return ExportedGraph(
        "paper",
        WHAT,
        tuple(graph.inputs),
        tuple(graph.outputs),
        graph.model("eitskin_paper", WHAT),
        frames_as_inputs(frames),
        {
            "probabilities": said.probabilities,
            "state": said.state,
            "bend_angle_deg": said.bend_angle_deg,
            "touch_map": said.touch_map,
            "static_picture": static_picture,
            "dynamic_picture": dynamic_picture,
        },
    )


def declared_frames(graph: GraphBuilder, layout: Layout) -> list[str]:
    """Inputs impedance, static_reference and dynamic_reference."""
    shape = (N, len(layout.protocol), 2)
    unit = "ohm; frames, measurements in the order of the table, real and imaginary part"
    names = ("impedance", "static_reference", "dynamic_reference")
    return [graph.input(Port(name, shape, "double", unit)) for name in names]


def frames_as_inputs(frames: Observed) -> dict[str, NDArray[np.float64]]:
    """Impedances and references of which `frames` are the relative differences."""
    flat = frames.flat * PHASE
    impedance = flat * (1.0 + frames.static)
    values = {
        "impedance": impedance,
        "static_reference": flat,
        "dynamic_reference": impedance / (1.0 + frames.dynamic),
    }
    return {name: np.stack([z.real, z.imag], axis=-1) for name, z in values.items()}


def _classified(graph: GraphBuilder, method: PaperMethod, static: str) -> str:
    stage = method.classifier
    maps, pixels, channels = stage.embedding.shape
    embedding = graph.constant(stage.embedding.reshape(maps * pixels, channels).T)
    value = graph.reshaped(graph.add("MatMul", static, embedding), -1, maps, *stage.shape)
    value = graph.cast(value, "float")
    if stage.compress:
        value = graph.add("Asinh", value)
    logits = graph.layers(stage.network.layers, value)
    return graph.add("Softmax", graph.cast(logits, "double"), axis=1)


def _angle(
    graph: GraphBuilder, method: PaperMethod, static: str, dynamic: str, touched: str
) -> str:
    stage, one = method.bend_angle, graph.constant(1.0)
    ratio = graph.add("Div", graph.add("Add", static, one), graph.add("Add", dynamic, one))
    column = graph.add("Unsqueeze", touched, graph.integers(1))
    difference = graph.add("Where", column, graph.add("Sub", ratio, one), static)
    square = graph.add("Mul", difference, difference)
    features = graph.add("Concat", difference, square, axis=1)
    chosen = graph.add("Gather", features, graph.constant(stage.features, np.int64), axis=1)
    angle = graph.add("MatMul", chosen, graph.constant(stage.coefficients))
    return graph.add("Add", angle, graph.constant(stage.intercept))


def _picture(graph: GraphBuilder, method: PaperMethod, difference: str) -> str:
    pixels = graph.add("MatMul", difference, graph.constant(method.reconstruction.matrix.T))
    return graph.reshaped(pixels, -1, *method.reconstruction.shape)


def _touch_map(
    graph: GraphBuilder, stage: PostProcessor, picture: str, touched: str, shape: tuple[int, int]
) -> str:
    """Zero where a frame is not touched."""
    scaled = graph.add("Div", picture, graph.constant(stage.scale))
    maps = graph.cast(graph.reshaped(scaled, -1, 1, *shape), "float")
    count = graph.add("Shape", maps, start=0, end=1)
    size = graph.add("Concat", count, graph.integers(2, *shape), axis=0)
    place = graph.constant(stage.network.place.numpy(), np.float32)
    value = graph.add("Concat", maps, graph.add("Expand", place, size), axis=1)
    logits = graph.reshaped(graph.layers(stage.network.layers, value), -1, *shape)
    column = graph.add("Unsqueeze", touched, graph.integers(1, 2))
    nothing = graph.constant(0.0, np.float32)
    return graph.add("Where", column, graph.add("Sigmoid", logits), nothing)
