"""The demo: every stage from the bare sensor to a live pipeline, and its report."""
