"""Studies of the physics: bends, presses, creep, and the signals and bounds that follow."""
