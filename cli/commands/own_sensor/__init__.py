"""Commands that fit a pipeline to the sensor available: adapt, calibrate and set up."""
