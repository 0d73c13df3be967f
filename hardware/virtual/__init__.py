"""The virtual board: the firmware's logic on simulated measurements, and its faults."""
