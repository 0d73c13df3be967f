"""Commands that fit a pipeline to the sensor at hand: adapt, calibrate and set up."""
