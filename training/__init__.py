"""Perception: training, calibrating, applying and evaluating pipelines.

A dataset trains a method (`joint` or `paper`, both behind `method`); `pipeline` turns the frames of
a session into estimates with it, `evaluation` scores these.
`positions` learns touch positions alone, from recordings without geometry; `reconstruction` makes
pictures without training; `twin` finds the physical numbers behind one sensor.
"""

from eitskin.extras import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__, __file__)
