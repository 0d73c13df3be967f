"""Sensor check: faults of electrodes, wires and front end.

Frames of the untouched sensor become statistics per channel (`checked_frames`); variation, values
and a fit of the contacts become findings in `sensor_check`. `reading_check` needs no model of
the sensor: it compares readings with the linear relations that any ideal meter obeys.
"""
