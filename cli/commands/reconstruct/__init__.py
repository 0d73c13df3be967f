"""The command `eitskin reconstruct`: sources of frames, pictures, and what becomes of them."""
