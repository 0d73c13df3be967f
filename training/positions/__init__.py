"""Touch positions on a sensor of unknown geometry, learned from labelled recordings.

`recorded_touches` splits a recording, `position_regressor` learns positions from its ratios; the
result is scored on the rest and saved as a pipeline is.
"""
