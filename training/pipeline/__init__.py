"""The perception pipeline: frames in, estimates out; calibration and the saved form."""
