"""Physics: from a sensor, bent and pressed, to the impedances at its electrodes."""

from eitskin.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__, __file__)
