"""Frames in quantity: what to generate, generating it, keeping it, reading it back."""

from eitskin.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__, __file__)
