"""Datasets in memory and on disk: schema, shards, folders with a manifest, and writing by frame.

A `Dataset` goes into the HDF5 shards of a `folder`; `torch_dataset` and `touch_map` give training
its tensors and its images of touches.
"""
