"""ONNX graphs, built node by node: no exporter that would bring a compiler along is needed."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from eitskin.extras import require

if TYPE_CHECKING:
    from torch import Tensor, nn

OPSET = 17
IR_VERSION = 8  # the file format that came with this opset
N = "n"  # name of the axis along which frames are stacked


@dataclass(frozen=True, slots=True)
class Port:
    """An input or output of a graph.

    Attributes:
        name: in the graph.
        shape: sizes; names stand for sizes that are free.
        dtype: "double", "float" or "int64".
        unit: of its values, and what their axes are.
    """

    name: str
    shape: tuple[int | str, ...]
    dtype: str
    unit: str


@dataclass(frozen=True, slots=True, eq=False)
class ExportedGraph:
    """A graph and what the pipeline itself makes of some inputs.

    Attributes:
        name: of its file, without ending.
        what: it computes, in a sentence.
        inputs, outputs: in their order.
        model: the file's bytes.
        feeds: values of the inputs.
        expected: values of the outputs, by the pipeline.
    """

    name: str
    what: str
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    model: bytes
    feeds: Mapping[str, NDArray[Any]]
    expected: Mapping[str, NDArray[Any]]


class GraphBuilder:
    """A graph that grows; every method gives the name of the value that it has added.

    Attributes:
        inputs: as declared so far.
        outputs: likewise.
    """

    def __init__(self) -> None:
        """Raises ImportError, naming the extra, where onnx is missing."""
        self._onnx = require("onnx", "onnx")
        self._nodes: list[Any] = []
        self._constants: list[Any] = []
        self.inputs: list[Port] = []
        self.outputs: list[Port] = []

    def input(self, port: Port) -> str:
        """Declare an input."""
        self.inputs.append(port)
        return port.name

    def output(self, port: Port, value: str) -> None:
        """Declare that `value` is an output."""
        self._nodes.append(self._onnx.helper.make_node("Identity", [value], [port.name]))
        self.outputs.append(port)

    def constant(self, values: Any, dtype: Any = np.float64) -> str:
        """An array that the graph holds."""
        name = f"c{len(self._constants)}"
        array = np.ascontiguousarray(values, dtype=dtype).reshape(np.shape(values))
        self._constants.append(self._onnx.numpy_helper.from_array(array, name))
        return name

    def add(self, operator: str, *inputs: str, **attributes: Any) -> str:
        """A node with one output."""
        name = f"v{len(self._nodes)}"
        self._nodes.append(self._onnx.helper.make_node(operator, inputs, [name], **attributes))
        return name

    def integers(self, *values: int) -> str:
        """Axes, sizes or indices."""
        return self.constant(np.array(values), np.int64)

    def reshaped(self, value: str, *shape: int) -> str:
        """`value` in another shape; one size may be -1."""
        return self.add("Reshape", value, self.integers(*shape))

    def cast(self, value: str, dtype: str) -> str:
        """`value` as "double" or "float"."""
        return self.add("Cast", value, to=getattr(self._onnx.TensorProto, dtype.upper()))

    def relative_difference(self, impedance: str, reference: str) -> str:
        """Re((V - r) / r) (n, C) of pairs of real and imaginary parts (n, C, 2)."""
        axis = self.integers(2)
        difference = self.add("Sub", impedance, reference)
        along = self.add("ReduceSum", self.add("Mul", difference, reference), axis, keepdims=0)
        square = self.add("ReduceSum", self.add("Mul", reference, reference), axis, keepdims=0)
        return self.add("Div", along, square)

    def dense(self, value: str, weight: NDArray[Any], bias: NDArray[Any]) -> str:
        """weight value + bias in single precision, (n, inputs) to (n, outputs)."""
        names = (self.constant(array, np.float32) for array in (weight, bias))
        return self.add("Gemm", value, *names, transB=1)

    def silu(self, value: str) -> str:
        """x times the logistic function of x."""
        return self.add("Mul", value, self.add("Sigmoid", value))

    def layers(self, module: "nn.Module", value: str) -> str:
        """A network of torch, layer by layer, in evaluation mode.

        Raises TypeError for a layer that is not known here.
        """
        from torch import nn

        match module:
            case nn.Sequential():
                for layer in module:
                    value = self.layers(layer, value)
            case nn.Conv2d() | nn.ConvTranspose2d():
                value = self._convolution(module, value)
            case nn.BatchNorm2d():
                value = self._normalised(module, value)
            case nn.Linear():
                value = self.dense(value, _array(module.weight), _array(module.bias))
            case nn.MaxPool2d():
                size = [int(module.kernel_size)] * 2  # type: ignore[arg-type]
                value = self.add("MaxPool", value, kernel_shape=size, strides=size)
            case nn.ReLU():
                value = self.add("Relu", value)
            case nn.Flatten():
                value = self.add("Flatten", value)
            case _:
                raise TypeError(f"no ONNX operator is known here for {type(module).__name__}")
        return value

    def _normalised(self, layer: "nn.BatchNorm2d", value: str) -> str:
        arrays = (layer.weight, layer.bias, layer.running_mean, layer.running_var)
        names = [self.constant(_array(array), np.float32) for array in arrays]
        return self.add("BatchNormalization", value, *names, epsilon=layer.eps)

    def _convolution(self, layer: "nn.Conv2d | nn.ConvTranspose2d", value: str) -> str:
        from torch import nn

        arrays = [layer.weight] if layer.bias is None else [layer.weight, layer.bias]
        names = [self.constant(_array(array), np.float32) for array in arrays]
        up, down = (int(size) for size in layer.padding)
        attributes: dict[str, Any] = {
            "strides": list(layer.stride),
            "dilations": list(layer.dilation),
            "pads": [up, down, up, down],
        }
        if isinstance(layer, nn.ConvTranspose2d):
            attributes["output_padding"] = list(layer.output_padding)
            return self.add("ConvTranspose", value, *names, **attributes)
        return self.add("Conv", value, *names, **attributes)

    def model(self, name: str, text: str) -> bytes:
        """The finished graph, checked, as the bytes of its file."""
        helper, types = self._onnx.helper, self._onnx.TensorProto
        inputs, outputs = (
            [
                helper.make_tensor_value_info(
                    port.name, getattr(types, port.dtype.upper()), list(port.shape)
                )
                for port in ports
            ]
            for ports in (self.inputs, self.outputs)
        )
        graph = helper.make_graph(self._nodes, name, inputs, outputs, self._constants)
        model = helper.make_model(
            graph,
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
            producer_name="eitskin",
            doc_string=text,
        )
        self._onnx.checker.check_model(model, full_check=True)
        return bytes(model.SerializeToString())


def _array(tensor: "Tensor | None") -> NDArray[Any]:
    """Trained values; every layer here has them."""
    array: NDArray[Any] = tensor.detach().numpy()  # type: ignore[union-attr]
    return array
