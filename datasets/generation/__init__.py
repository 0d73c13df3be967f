"""Simulation of a recipe's shards on all cores or a cluster, resumable, and their verification.

`generate` gives shards to the workers of `process_pool` or `cluster`, which run `shard_simulation`.
"""
