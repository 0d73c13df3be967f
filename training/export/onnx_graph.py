"""ONNX graphs as expressions: values with operators, each of which adds a node.

`torch.onnx` would take onnxscript, seconds a graph and as many lines for the stages around the
networks (docs/interoperability.md).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.extras import require
from eitskin.training.paper.layers import (
    EPSILON,
    BatchNorm,
    Convolution,
    Dense,
    Layer,
    Layers,
    MaxPool,
    Rectifier,
    TransposedConvolution,
)

OPSET = 17
IR_VERSION = 8  # the file format that came with this opset
BATCH = "n"  # name of the axis along which frames are stacked
TYPES = {"float64": "double", "float32": "float", "int64": "int64"}  # of numpy and of ONNX


@dataclass(frozen=True, slots=True)
class TensorSpec:
    """Name, shape, type and unit of an input or output of a graph.

    Attributes:
        name: in the graph.
        shape: sizes of the axes; a name stands for a free size.
        dtype: "double", "float" or "int64".
        unit: unit of the values, and the meaning of the axes.
    """

    name: str
    shape: tuple[int | str, ...]
    dtype: str
    unit: str


def _operator(name: str) -> "Callable[[Value, Value | ArrayLike], Value]":
    """Method that applies an ONNX operator to two values."""
    return lambda left, right: left.op(name, right)


@dataclass(frozen=True, slots=True)
class Value:
    """A tensor inside a graph; operators take further values, numbers and arrays."""

    graph: "Graph"
    name: str

    def op(self, operator: str, *others: "Value | ArrayLike", **attributes: Any) -> "Value":
        """Output of an ONNX operator whose first input is this value."""
        return self.graph.node(operator, self, *others, **attributes)

    __add__ = _operator("Add")
    __sub__ = _operator("Sub")
    __mul__ = _operator("Mul")
    __truediv__ = _operator("Div")
    __matmul__ = _operator("MatMul")

    def cast(self, dtype: str) -> "Value":
        """The value as "double" or "float"."""
        return self.op("Cast", to=getattr(require("onnx", "onnx").TensorProto, dtype.upper()))

    def sum(self, axis: int) -> "Value":
        """Sum along an axis, which disappears."""
        return self.op("ReduceSum", [axis], keepdims=0)

    def dense(self, weight: NDArray[Any], bias: NDArray[Any]) -> "Value":
        """weight value + bias in single precision, (n, inputs) to (n, outputs)."""
        return self.op("Gemm", weight.astype(np.float32), bias.astype(np.float32), transB=1)

    def silu(self) -> "Value":
        """x times the logistic function of x."""
        return self * self.op("Sigmoid")


class Graph:
    """Nodes and constants of an ONNX graph under construction."""

    def __init__(self) -> None:
        """Raises ImportError, naming the extra, where onnx is missing."""
        self._onnx = require("onnx", "onnx")
        self._nodes: list[Any] = []
        self._constants: list[Any] = []

    def node(self, operator: str, *inputs: Value | ArrayLike, **attributes: Any) -> Value:
        """Output of an ONNX operator; numbers and arrays become constants of the graph."""
        names = [v.name if isinstance(v, Value) else self._constant(v) for v in inputs]
        value = Value(self, f"v{len(self._nodes)}")
        self._nodes.append(self._onnx.helper.make_node(operator, names, [value.name], **attributes))
        return value

    def _constant(self, values: ArrayLike) -> str:
        name = f"c{len(self._constants)}"
        array = np.array(values, order="C")
        self._constants.append(self._onnx.numpy_helper.from_array(array, name))
        return name

    def model(
        self,
        name: str,
        what: str,
        inputs: Sequence[TensorSpec],
        outputs: Mapping[TensorSpec, Value],
    ) -> bytes:
        """Bytes of the checked ONNX file."""
        helper, types = self._onnx.helper, self._onnx.TensorProto
        for spec, value in outputs.items():
            self._nodes.append(helper.make_node("Identity", [value.name], [spec.name]))
        ports = (
            [
                helper.make_tensor_value_info(s.name, getattr(types, s.dtype.upper()), s.shape)
                for s in specs
            ]
            for specs in (inputs, outputs)
        )
        model = helper.make_model(
            helper.make_graph(self._nodes, name, *ports, self._constants),
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
            producer_name="eitskin",
            doc_string=what,
        )
        self._onnx.checker.check_model(model, full_check=True)
        return bytes(model.SerializeToString())


@dataclass(frozen=True, slots=True, eq=False)
class ExportedGraph:
    """An ONNX graph, some inputs, and the outputs of the pipeline itself for these inputs.

    Attributes:
        name: file name without its ending.
        what: one sentence on what the graph computes.
        inputs, outputs: in their order.
        model: bytes of the file.
        feeds: values of the inputs.
        expected: values of the outputs, computed by the pipeline.
    """

    name: str
    what: str
    inputs: tuple[TensorSpec, ...]
    outputs: tuple[TensorSpec, ...]
    model: bytes
    feeds: Mapping[str, NDArray[Any]]
    expected: Mapping[str, NDArray[Any]]

    @classmethod
    def of(
        cls,
        name: str,
        what: str,
        build: Callable[..., Sequence[Value]],
        feeds: Mapping[str, NDArray[Any]],
        expected: Mapping[str, NDArray[Any]],
        units: Mapping[str, str],
    ) -> "ExportedGraph":
        """Export of the expressions that `build` makes.

        Args:
            name: file name without its ending.
            what: one sentence on what the graph computes.
            build: takes the inputs and gives the outputs, as values of a graph.
            feeds: inputs (n, ...) by name, in the order in which `build` takes them.
            expected: outputs (n, ...) by name, in the order in which `build` gives them.
            units: units of inputs and outputs.
        """
        inputs, outputs = (
            tuple(
                TensorSpec(key, (BATCH, *array.shape[1:]), TYPES[array.dtype.name], units[key])
                for key, array in arrays.items()
            )
            for arrays in (feeds, expected)
        )
        graph = Graph()
        values = build(*(Value(graph, spec.name) for spec in inputs))
        built = dict(zip(outputs, values, strict=True))
        model = graph.model(f"eitskin_{name}", what, inputs, built)
        return cls(name, what, inputs, outputs, model, feeds, expected)


def relative_difference(impedance: Value, reference: Value) -> Value:
    """Re((V - r) / r) (n, C) of pairs of real and imaginary parts (n, C, 2)."""
    return ((impedance - reference) * reference).sum(2) / (reference * reference).sum(2)


def network(layers: Layers, value: Value) -> Value:
    """Output of the last layer of a network."""
    for layer in layers:
        value = _output(layer, value)
    return value


def _output(layer: Layer, value: Value) -> Value:
    """Output of a layer by the ONNX operator of its kind."""
    if isinstance(layer, Convolution):
        arrays = [layer.weight] if layer.bias is None else [layer.weight, layer.bias]
        steps = {
            "strides": [layer.stride] * 2,
            "dilations": [layer.dilation] * 2,
            "pads": [layer.dilation] * 4,
        }
        return value.op("Conv", *arrays, **steps)
    if isinstance(layer, TransposedConvolution):
        odd = layer.weight.shape[2] % 2
        steps = {"strides": [2, 2], "pads": [1, 1, 1, 1], "output_padding": [odd, odd]}
        return value.op("ConvTranspose", layer.weight, layer.bias, **steps)
    if isinstance(layer, BatchNorm):
        arrays = [layer.weight, layer.bias, layer.running_mean, layer.running_var]
        return value.op("BatchNormalization", *arrays, epsilon=EPSILON)
    if isinstance(layer, Dense):
        return value.dense(layer.weight, layer.bias)
    if isinstance(layer, MaxPool):
        return value.op("MaxPool", kernel_shape=[2, 2], strides=[2, 2])
    return value.op("Relu" if isinstance(layer, Rectifier) else "Flatten")
