"""Touch positions on one sensor, learned from few labelled presses of it.

`press_fit` learns maps of all channels over the sheet (`channel_maps`), with what a design shows of
them (`sheet`), and `locator` inverts them. `touch_positions` is the method for a `Pipeline`.
"""
