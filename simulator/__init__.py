"""Physics: impedances between the electrodes of a bent, pressed sensor.

A `scene` says what happens, `mechanics` solves presses and bends, `layer` pulls the deformed
conductivity back to the flat mesh, `electrical` solves the complete electrode model with `linalg`,
`instrument` adds the errors of a board; `simulator` joins these steps and `view` draws them.
"""

from eitskin.extras import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__, __file__)
