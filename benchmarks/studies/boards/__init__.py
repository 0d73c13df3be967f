"""Studies of boards: signal chain, damage on the line, sensor check, live loop and page."""
