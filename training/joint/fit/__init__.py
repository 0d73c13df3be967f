"""Fit of bend and touches to one frame: the objective, its minimisation, and model selection."""
