"""Instrument model: noise, drift and errors that a board adds to noise-free frames.

An `Instrument` states the error terms of a board; a `Session` draws what stays the same from one
calibration to the next and measures frames; `ad5940` is the chip's signal chain, and `meter` a
general four-terminal meter. `meter_fit` fits its parameters to flat frames, and chooses among them.
"""
