"""Boards: the wire, the host's side of it, virtual boards, recordings, and the live loop."""

from eitskin.lazy import offered

__all__, __getattr__, __dir__ = offered(__name__, __file__)
