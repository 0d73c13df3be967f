"""Datasets in memory and on disk: the shard format, whole files, reading and writing."""
