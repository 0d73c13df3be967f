"""Contact shapes: the same force on four indenters, and what each does to the gel beneath."""

import dataclasses
import itertools
from pathlib import Path

import numpy as np

from eitskin.datasets import Recipe
from eitskin.datasets.recipe.frame_sampling import sample
from eitskin.geometry import SensorDesign
from eitskin.simulator import Mechanics, Profile, Scene
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress, Indentation
from eitskin.simulator.scene.indenters import Indenter

from style import GOLD, GREY, ORANGE, PALE, RED, TEAL, figure, save, wanted

# The scene presses with a flat cylinder and a ball, and the recipe with either. Any other convex
# body of revolution is given by its heights over some radii, here a shallow dome and a cone.
SCENES = Path(__file__).parent / "scenes"
cylinder, ball = (touch.indenter for touch in Scene.from_toml(SCENES / "shape.toml").touches)
r = np.linspace(0.0, 0.0075, 16)
dome = Profile(tuple(r.tolist()), tuple((0.020 - np.sqrt(0.020**2 - r**2)).tolist()))
cone = Profile((0.0, 0.001, 0.0075), (0.0, 0.0001, 0.0030))
shapes: dict[str, Indenter] = {"flat cylinder": cylinder, "dome": dome, "cone": cone, "ball": ball}
recipe = Recipe.from_toml(SCENES / "shape_recipe.toml")
by = [sample(recipe, k).scene.touches[0].indenter for k in range(recipe.frames)]
print(f"{by.count(cylinder)} frames of the recipe by the cylinder, {by.count(ball)} by the ball")
assert by.count(cylinder) == by.count(ball) == 200

# 6 N on each, on the stack of silicone, gel and silicone. A body that sticks to the silicone is
# held by friction, too; without friction the pressure carries all of the force.
FORCE = 6.0
stack = Mechanics().stack(SensorDesign.reference())


def press(shape: Indenter) -> Indentation:
    """Equilibrium under the force, on cells of a tenth of the radius at the contact."""
    return AxisymmetricPress(stack, shape, finest=0.00075).to_force(FORCE)


def carried(found: Indentation) -> float:
    """Force that the contact pressure carries [N]."""
    return float(2.0 * np.pi * np.trapezoid(found.pressure * found.radii, found.radii))


pressed = {name: press(shape) for name, shape in shapes.items()}
for name, found in pressed.items():
    print(
        f"{name}: {1e3 * found.depth:.2f} mm deep, gel {found.thinning(1):.0%} thinner; "
        f"pressure carries {carried(found):.1f} N"
    )
    assert 0.8 * FORCE < carried(found) < FORCE
smooth = press(dataclasses.replace(ball, rough=False))
print(f"the ball without friction: pressure carries {carried(smooth):.2f} N")
assert abs(carried(smooth) / FORCE - 1.0) < 0.01
# The fuller the body, the less deep it goes and the less it thins the gel.
assert (np.diff([found.depth for found in pressed.values()]) > 0.0).all()
assert (np.diff([found.thinning(1) for found in pressed.values()]) > 0.0).all()

# Gel keeps its volume: what leaves from under the indenter thickens a ring around it.
bottom, top = (int(np.abs(found.z - each).argmin()) for each in stack.levels[1:3])


def thinner(found: Indentation) -> np.ndarray:
    """How much thinner the gel is at the radii of the mesh [%]."""
    gone = found.displacement[:, bottom, 1] - found.displacement[:, top, 1]
    return np.asarray(100.0 * gone / (found.z[top] - found.z[bottom]))


assert all(thinner(found).min() < -1.0 for found in pressed.values())

if wanted():
    drawn, axes = figure(2, 4, (7.2, 3.7), height_ratios=(1.0, 1.6))
    colour = dict(zip(shapes, (TEAL, GOLD, ORANGE, RED), strict=True))
    wide = np.linspace(-0.0075, 0.0075, 201)
    for axis, (name, found) in zip(axes[0], pressed.items(), strict=True):
        near = found.r < 0.022
        at = np.stack(np.meshgrid(found.r[near], found.z, indexing="ij"), axis=-1)
        half = 1e3 * (at + found.displacement[near])
        both = np.concatenate([half[:0:-1] * [-1.0, 1.0], half])
        faces = itertools.pairwise(int(np.abs(found.z - each).argmin()) for each in stack.levels)
        for (low, high), fill in zip(faces, (PALE, "#b8dcd9", PALE), strict=True):
            axis.fill(*np.concatenate([both[:, low], both[::-1, high]]).T, color=fill, lw=0)
        tip = 1e3 * (stack.levels[-1] - found.depth + shapes[name].profile(np.abs(wide))[0])
        axis.fill_between(1e3 * wide, tip, np.maximum(tip, 15.0), color=colour[name], lw=0)
        axis.set(xlim=(-16, 16), ylim=(0, 15), title=name)
        axis.set_aspect("equal", anchor="S")
        axis.axis("off")
    for axis in axes[1]:
        axis.remove()
    left, right = drawn.add_subplot(2, 2, 3), drawn.add_subplot(2, 2, 4)
    for place, (name, found) in enumerate(pressed.items()):
        bar = left.barh(-place, 1e3 * found.depth, 0.6, color=colour[name])
        left.bar_label(bar, [f"{1e3 * found.depth:.1f}"], padding=3)
        right.plot(1e3 * found.r, thinner(found), color=colour[name])
    left.set_yticks(-np.arange(4), list(shapes))
    left.set(xlabel="[mm]", xlim=(0, 5), title="how deep 6 N go")
    right.axhline(0.0, color=GREY, lw=0.8)
    right.set(xlabel="distance from the axis [mm]", ylabel="[%]", xlim=(0, 25))
    right.set(title="how much thinner the gel is")
    save(drawn, __file__)
