"""Meshes of a sensor's conductive layer, refined at the electrodes, and their quality."""
