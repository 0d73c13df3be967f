"""Export of a pipeline as ONNX graphs, each checked against the pipeline before it is written."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.folder import make_folder
from eitskin.errors import ConfigurationError, DataError
from eitskin.extras import require
from eitskin.files import atomic_file
from eitskin.training.export import onnx_joint, onnx_paper
from eitskin.training.export.onnx_graph import OPSET, ExportedGraph
from eitskin.training.joint.method import JointMethod
from eitskin.training.paper.method import PaperMethod
from eitskin.training.pipeline.pipeline import Pipeline

FORMAT = "eitskin-onnx"
FORMAT_VERSION = 1
DOCUMENT = "graphs.json"
TOLERANCE = 1e-5  # of an output, relative to the largest; networks are in single precision


def graphs_of(pipeline: Pipeline) -> tuple[list[ExportedGraph], tuple[str, ...]]:
    """The graphs of a pipeline, and in words the steps that are not in them.

    Raises DataError without frames to check with, and ConfigurationError for a method that has no
    graphs.
    """
    method, golden = pipeline.method, pipeline.examples
    frames = golden[np.flatnonzero(np.isfinite(golden.static + golden.dynamic).all(axis=1))]
    if not len(frames):
        raise DataError(
            "the pipeline keeps no golden frame without bad channels, so its graphs cannot be "
            "checked; train it again on frames whose channels are good"
        )
    if isinstance(method, PaperMethod):
        return [onnx_paper.paper_graph(method, frames)], onnx_paper.NOT_IN_GRAPH
    if isinstance(method, JointMethod):
        if not method.touches:
            raise ConfigurationError(
                "expected a pipeline that estimates touches, got one of the bend alone, which has "
                "no networks to export; its bend curve is in the arrays of the saved pipeline"
            )
        graphs = (onnx_joint.proposals_graph, onnx_joint.response_graph)
        return [graph(method, frames) for graph in graphs], onnx_joint.NOT_IN_GRAPH
    raise ConfigurationError(
        f"expected a pipeline of the paper's or the joint method, got the method '{method.KIND}', "
        "which has no graphs"
    )


def export_onnx(
    pipeline: Pipeline, folder: str | Path, tolerance: float = TOLERANCE
) -> dict[str, Any]:
    """Write the graphs of a pipeline and a description of their inputs and outputs.

    Args:
        pipeline: trained, and exported with its calibration if it has one.
        folder: made if missing.
        tolerance: largest allowed difference between graph and pipeline on the golden frames,
            relative to the largest value of an output.

    Returns:
        The description, as written to `DOCUMENT`.

    Raises:
        ImportError: naming the extra, without onnx or onnxruntime.
        DataError: for a graph that differs by more; nothing is written then.
        ConfigurationError: for a folder that cannot be made or written to.
    """
    graphs, left_out = graphs_of(pipeline)
    differences = [checked(graph, tolerance) for graph in graphs]
    entries = [
        _entry(graph, found, tolerance) for graph, found in zip(graphs, differences, strict=True)
    ]
    document = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "method": pipeline.method.KIND,
        "opset": OPSET,
        "graphs": entries,
        "not_in_graphs": list(left_out),
        "layout": pipeline.layout.document(),
        "outline_m": list(pipeline.layout.outline),
        "trained_on": dict(pipeline.trained_on),
        "calibrated": bool(pipeline.calibration),
    }
    text = json.dumps(document, indent=2, allow_nan=False) + "\n"
    files = {f"{graph.name}.onnx": graph.model for graph in graphs}
    make_folder(Path(folder))
    for name, content in (files | {DOCUMENT: text.encode()}).items():
        with atomic_file(Path(folder) / name) as temporary:
            temporary.write_bytes(content)
    return document


def run_graph(model: bytes, feeds: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Outputs of a graph by name, by onnxruntime on one thread."""
    runtime = require("onnxruntime", "onnx")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 3
    session = runtime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    return dict(zip(names, session.run(names, dict(feeds)), strict=True))


def checked(graph: ExportedGraph, tolerance: float = TOLERANCE) -> dict[str, float]:
    """Largest difference of each output from the pipeline's; raises DataError above `tolerance`."""
    computed, differences = run_graph(graph.model, graph.feeds), {}
    for name, expected in graph.expected.items():
        if computed[name].shape != expected.shape:
            raise DataError(
                f"{graph.name}.onnx: expected '{name}' of shape {expected.shape}, got "
                f"{computed[name].shape}; nothing is written"
            )
        error = float(np.max(np.abs(computed[name] - expected)))
        allowed = tolerance * float(np.max(np.abs(expected)))
        if not error <= allowed:
            raise DataError(
                f"{graph.name}.onnx does not compute what the pipeline does: '{name}' differs by "
                f"{error:.3g}, allowed is {allowed:.3g}; nothing is written; install the versions "
                "of onnx and onnxruntime in constraints.txt"
            )
        differences[name] = error
    return differences


def _entry(
    graph: ExportedGraph, differences: Mapping[str, float], tolerance: float
) -> dict[str, Any]:
    """Description of one graph, as JSON takes it."""
    outputs = [
        asdict(spec)
        | {
            "largest_difference": differences[spec.name],
            "allowed_difference": tolerance * float(np.max(np.abs(graph.expected[spec.name]))),
        }
        for spec in graph.outputs
    ]
    return {
        "file": f"{graph.name}.onnx",
        "sha256": hashlib.sha256(graph.model).hexdigest(),
        "bytes": len(graph.model),
        "what": graph.what,
        "inputs": [asdict(spec) for spec in graph.inputs],
        "outputs": outputs,
        "checked_with": len(next(iter(graph.expected.values()))),
    }
