"""Trained pipelines as ONNX graphs."""
