"""Interface of a perception method, and the data types that every method shares.

Frames that fit `input_spec` become `observations`, a method turns those into `predictions`.
`settings`, `network_training`, `learning_curve` serve training, `calibration` one sensor.
"""
