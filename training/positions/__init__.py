"""Touch positions on a sensor of unknown geometry, learned from labelled recordings."""
