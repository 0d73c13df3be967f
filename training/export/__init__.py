"""Trained pipelines as ONNX graphs, each checked against its pipeline by onnxruntime.

`onnx_export.export_onnx` writes them; `onnx_paper` and `onnx_joint` are the graphs of the methods.
"""
