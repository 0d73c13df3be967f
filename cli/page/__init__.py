"""The live page: its server, its state, and what it may ask of a board."""
