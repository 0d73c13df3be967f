"""A clamped sensor of one material, and cells coarse enough to solve it quickly."""

from eitskin.geometry import Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.materials import NeoHookean

COARSE = Grading(finest=4e-3, coarsest=8e-3, growth=0.5)


def plain(length, width, thickness):
    """A sensor without encapsulation and its material, so that theory has one modulus."""
    outline = Rectangle(length, width)
    design = SensorDesign(outline, thickness, uniform(outline, 4), encapsulated_thickness=thickness)
    rubber = NeoHookean(20e3)
    return design, Mechanics(rubber, rubber, margin=0.0)
