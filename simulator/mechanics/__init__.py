"""Solid mechanics of the encapsulated gel: materials, equilibrium, presses and bends."""
