"""Benchmark set `skinbench`: frozen recipes, scores by definition, and a leaderboard."""
