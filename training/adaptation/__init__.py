"""Touch positions on one sensor, learned from few labelled presses of it.

`press_fit` learns maps of all channels over the sheet (`channel_maps`), with what a design tells of
them (`place_kernel`, `sectors`), and `press_locator` inverts them (`map_grid`). `recorded_touches`
splits a recording, scores on the rest and is saved as a pipeline is; `position_regressor` is what
version 0.1 learned.
"""
