"""Simulation of a recipe's shards on all cores or a cluster, resumable.

`preparation` solves the tables that a recipe needs and estimates its cost; `generate` gives shards
to workers, which run `shard_simulation`.
"""
