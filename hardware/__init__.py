"""Boards: the wire, the host's side of it, virtual boards, recordings, and the live loop."""

from eitskin.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__, __file__)
