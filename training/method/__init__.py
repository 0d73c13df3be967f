"""Interface of a perception method, and the data types that every method shares.

Frames that fit `input_spec` become `observations`, a method turns those into `predictions`.
`settings`, `targets` and `network_training` serve training, `known_frames` the adaptation.
"""
