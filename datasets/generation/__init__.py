"""Simulating a recipe's shards on all cores or a cluster, resumably, and verifying them."""
