"""Frames in quantity: what to generate, generating it, keeping it, reading it back."""

from eitskin.lazy import offered

__all__, __getattr__, __dir__ = offered(__name__, __file__)
