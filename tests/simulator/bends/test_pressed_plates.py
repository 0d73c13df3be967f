"""Tabulated presses on plates: against coupled solutions, symmetry, limits, and their refusals."""

import dataclasses

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Clamp, Plates, Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.simulator import Cylinder, Mechanics
from eitskin.simulator.bends import bend_table, pressed_plates
from eitskin.simulator.bends.pressed_plates import PlateBend, PlatesCase
from eitskin.simulator.deformation.contact import ContactFrame, DentField
from eitskin.simulator.deformation.field import Field
from eitskin.simulator.deformation.finite_stack import FiniteStack
from eitskin.simulator.deformation.sensor_grid import OWN_GRID
from eitskin.simulator.deformation.tabled_corrections import rectangle_sums
from eitskin.simulator.mechanics.stack_mesh import Fineness

pytestmark = pytest.mark.slow

SIZE, SPAN, PUNCH, MECHANICS = Rectangle(0.080, 0.040), 0.020, Cylinder(0.006), Mechanics()
DESIGN = SensorDesign(SIZE, 0.005, uniform(SIZE, 8), support=Plates(SPAN))
CLAMP = Clamp(SPAN, faces="bottom")
COARSE = {
    "ANGLES_DEG": (0.0, 10.0, 20.0),
    "_PARTS": (1.0,),
    "_DEEPEST": 0.08,
    "_IN_GAP": 0.05,
    "_ON_PLATE": (1.0,),
    "_BETWEEN": 0.5,
    "_FROM_SIDE": (0.55,),
    "_FINENESS": Fineness(ends=0.0, sides=0.0, layers=1, rims=0.8, growth=2.0),
    "_WORKERS": 1,
}
# Angles of bend tables; all that the sensor of this file needs.
BENDS_DEG = (-8.0, 0.0, 8.0, 14.0, 22.0)
INSIDE = np.stack(
    np.meshgrid([0.008, 0.022, 0.034, 0.041, 0.055], [0.004, 0.018, 0.033], [0.001, 0.004]), -1
).reshape(-1, 1, 3)


@pytest.fixture(scope="module")
def plates(tmp_path_factory):
    """Sensor of this file on plates at an angle, its table solved on a coarse mesh."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EITSKIN_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.setattr(bend_table, "ANGLES_DEG", BENDS_DEG)
        for name, value in COARSE.items():
            patch.setattr(pressed_plates, name, value)
        yield lambda angle: PlateBend(DESIGN, CLAMP, MECHANICS, OWN_GRID, angle)


def changed(held: PlateBend, x: float, y: float, depth: float) -> tuple[Field, float]:
    """What plates change of a press: the field, and by how much deeper it sinks [m]."""
    sums = rectangle_sums(DESIGN, 1, 3)
    at = np.array([[x, y, depth]]), np.array([held.angle_deg]), np.zeros(1, int)
    (extra,) = held.evaluate(PUNCH, *at, sums)
    (field,) = sums.fields(DESIGN.thickness, np.array([1.0, 1.0, DESIGN.thickness]))
    return field, float(extra)


def moved(field: Field, points: np.ndarray = INSIDE) -> np.ndarray:
    return field.displacement_and_gradient(points)[:3, 0].T


def coupled(held: PlateBend, x: float, y: float, depth: float) -> tuple[np.ndarray, float]:
    """What the plates change of a press, from two solutions on one mesh."""
    case = PlatesCase(DESIGN, CLAMP, MECHANICS, PUNCH)
    about, middle = case.indentations, 0.5 * SIZE.length
    (dent,) = about.with_depths([depth / about.thickness]).dents
    body = about.mesh(SIZE, [(x, y)], pressed_plates._FINENESS)
    over_base = INSIDE[:, 0] + np.array([0.0, 0.0, 0.0035])

    def press(mesh, shape, state):
        frame = shape and ContactFrame.from_bent_top(shape, x, y, about.stack)
        field = DentField(x, y, PUNCH, dent, frame)
        found = FiniteStack(mesh, 1, state).correction([field]) if mesh else None
        return field.evaluate(over_base).displacement, found, frame

    there, bent, _ = press(body, held.state, held.state)
    _, flat, _ = press(dataclasses.replace(body, gap=(middle, middle)), None, None)
    here, _, gel = press(None, held.bend, None)
    rigid = flat.displacement(over_base)
    rigid = rigid if gel is None else gel.rotate_vectors(rigid)
    change = there + bent.displacement(over_base) - here - rigid
    return change, float(bent.sunk[0] - flat.sunk[0])


@pytest.mark.parametrize(
    ("angle", "place", "depth"),
    [(14.0, (0.030, 0.020), 5e-4), (0.0, (0.033, 0.014), 5e-4)],
)
def test_a_tabulated_press_is_the_coupled_solution(plates, angle, place, depth) -> None:
    """At an angle, at a place, and at depths that were not solved for the table."""
    held = plates(angle)
    change, sunk = coupled(held, *place, depth)
    field, extra = changed(held, *place, depth)
    assert np.linalg.norm(moved(field) - change) < 0.08 * np.linalg.norm(change)
    assert extra == pytest.approx(sunk, rel=0.08, abs=0.01 * depth)


def test_a_quarter_stands_for_all_and_presses_end_flat_within_the_table(plates):
    held, (x, y), depth = plates(10.0), (0.028, 0.013), 5e-4
    field = changed(held, x, y, depth)[0]
    for axis, place in ((0, (SIZE.length - x, y)), (1, (x, SIZE.width - y))):
        image = INSIDE.copy()
        image[..., axis] = (SIZE.length, SIZE.width)[axis] - image[..., axis]
        signs = np.where(np.arange(3) == axis, -1.0, 1.0)
        other = moved(changed(held, *place, depth)[0])
        assert other == pytest.approx(moved(field, image) * signs, abs=1e-6 * depth)
    held = plates(10.0)
    (deep, sunk), (shallow, less) = (changed(held, 0.030, 0.020, each) for each in (4e-4, 4e-7))
    assert less == pytest.approx(1e-3 * sunk, rel=1e-9)
    assert np.abs(moved(shallow)).max() < 2e-3 * np.abs(moved(deep)).max()
    flat, nearly = (changed(plates(each), 0.030, 0.020, 4e-4)[0] for each in (0.0, 1e-3))
    assert moved(nearly) == pytest.approx(moved(flat), abs=1e-3 * np.abs(moved(flat)).max())
    for angle, x, depth in ((25.0, 0.02, 1e-4), (0.0, 0.02, 2e-3), (0.0, 0.04, 9e-4)):
        with pytest.raises(ConfigurationError, match="touches on plates are tabulated"):
            changed(plates(angle), x, 0.02, depth)
