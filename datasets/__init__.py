"""Datasets: labelled frames, simulated or measured.

A `recipe` describes a dataset, `generation` simulates its shards on all cores or a cluster, and
`store` holds the format, writes and reads; `recordings` imports what other boards measured.
"""

from eitskin.extras import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__, __file__)
