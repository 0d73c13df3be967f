"""Geometry of a sensor, without physics: `design`, `meshing` and `deformation`.

A `SensorDesign` says outline, thickness and electrodes; `meshing` turns a design into a `Mesh`;
`deformation` maps points of the flat sensor to the bent one, with the deformation gradient.
"""

from eitskin.extras import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__, __file__)
