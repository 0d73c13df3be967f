"""Physics: from a sensor, bent and pressed, to the impedances at its electrodes."""

from eitskin.lazy import offered

__all__, __getattr__, __dir__ = offered(__name__, __file__)
