"""Bends and dents: F is the derivative of the map, volumes are kept, limits are met."""

import dataclasses
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry import Bend, Electrode, FreeArc, Hinge, Rectangle, Roll, SensorDesign, Twist
from eitskin.geometry.deformation.electrode_shift import electrode_shift
from eitskin.geometry.deformation.kinematics import (
    WHOLE_TENSOR,
    Composition,
    Displaced,
    area_ratio,
    pulled_back_entries,
)
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.simulator import Touch
from eitskin.simulator.deformation.press_table import sketched_dents

from alternatives import pulled_back

DESIGN = SensorDesign.reference()
HINGE = Hinge(span=0.040, offset=0.008)
SHARP = Hinge(give=0.0, contraction=0.0)  # Rivlin's flexure between rigid ends


def points(n: int = 200, seed: int = 3, clear: float = 1e-4) -> NDArray[np.float64]:
    """Random points of the layer, off the clamps where F jumps."""
    rng = np.random.default_rng(seed)
    x = rng.uniform([0, 0, 0], [0.150, 0.060, 0.005], (n, 3))
    return x[
        (np.abs(np.abs(x[:, 0] - 0.075) - 0.020) > clear)
        & (np.abs(np.abs(x[:, 0] - 0.075) - 0.022) > clear)
    ]


def derivative(deformation, x: NDArray[np.float64], step: float = 1e-7) -> NDArray[np.float64]:
    """Central differences of positions, (..., 3, 3)."""
    columns = [
        (deformation.positions(x + e) - deformation.positions(x - e)) / (2 * step)
        for e in step * np.eye(3)
    ]
    return np.stack(columns, axis=-1)


DENTS = sketched_dents((Touch(0.050, 0.020, 10.0), Touch(0.090, 0.041, 7.0)), DESIGN)
DEFORMATIONS = {
    "bend": HINGE.flexure(DESIGN, Bend(40.0)),
    "bend back": HINGE.flexure(DESIGN, Bend(-20.0)),
    "slight bend": HINGE.flexure(DESIGN, Bend(1e-7)),
    "soft clamps": Hinge(transition=0.006, contraction=0.5).flexure(DESIGN, Bend(45.0)),
    "soft clamps, back": Hinge(transition=0.02, contraction=1.0).flexure(DESIGN, Bend(-25.0)),
    "free arc": FreeArc(0.150).flexure(DESIGN, Bend(300.0)),
    "free arc over a part": FreeArc(0.06, 0.01, 0.3).flexure(DESIGN, Bend(-120.0)),
    "twist": Twist(40.0).deformation(DESIGN),
    "roll": Roll(-200.0).deformation(DESIGN),
    "roll, then twist": Composition(
        Roll(30.0).deformation(DESIGN), Twist(20.0).deformation(DESIGN)
    ),
    "displaced": Displaced(lambda x: 0.02 * np.sin(10 * x[..., [1, 2, 0]])),
    "dents": DENTS,
    "dents, then bend": Composition(DENTS, HINGE.flexure(DESIGN, Bend(30.0))),
}


@pytest.mark.parametrize("name", DEFORMATIONS)
def test_gradient_is_the_derivative_of_positions(name) -> None:
    deformation, x = DEFORMATIONS[name], points()
    assert deformation.gradient(x) == pytest.approx(derivative(deformation, x), abs=3e-6)


@pytest.mark.parametrize("name", [n for n in DEFORMATIONS if n != "displaced"])
def test_gels_keep_their_volume(name) -> None:
    """Tables of dents keep it up to the polynomials that they are stored by."""
    J = np.linalg.det(DEFORMATIONS[name].gradient(points()))
    assert J == pytest.approx(1.0, abs=1e-2 if "dents" in name else 1e-12)


def test_bent_sheets_obey_the_hinge_with_free_faces_and_sharp_clamps_as_limit():
    """From one to the other the radial stress changes by int (lambda - lambda^-3) d lambda."""
    arc = FreeArc(0.060).flexure(DESIGN, Bend(90.0))
    half = 0.5 * DESIGN.encapsulated_thickness * np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    top, bottom = np.linalg.norm(arc.gradient(arc.centre + half)[..., 0], axis=-1)
    assert top > 1.1
    mid = np.linalg.norm(arc.gradient(np.array(arc.centre))[:, 0])
    assert mid**4 == pytest.approx(1.0 + (math.radians(90.0) / 0.060 * 0.012) ** 2, rel=1e-9)
    assert top**2 + top**-2 == pytest.approx(bottom**2 + bottom**-2, rel=1e-12)
    # lambda_0 = (theta/2) cot(theta/2) + d theta / s.
    theta = math.radians(50.0)
    expected = theta / 2 / math.tan(theta / 2) + 0.008 * theta / 0.040
    assert SHARP.flexure(DESIGN, Bend(50.0)).stretch == pytest.approx(expected, rel=1e-9)
    x = points(clear=2e-3)
    sharp = SHARP.flexure(DESIGN, Bend(50.0)).positions(x)
    hinges = (Hinge(give=0.0, transition=t, contraction=0.0) for t in (2e-3, 1e-3))
    soft = [hinge.flexure(DESIGN, Bend(50.0)).positions(x) for hinge in hinges]
    assert 2e-6 < np.abs(soft[1] - sharp).max() < 0.6 * np.abs(soft[0] - sharp).max()
    # Arc length over the span is lambda_0 s, whatever the angle.
    for angle in (-20.0, 30.0, 90.0):
        bend = SHARP.flexure(DESIGN, Bend(angle))
        x = np.linspace(0.055, 0.095, 4001)
        path = bend.positions(np.stack([x, 0 * x + 0.03, 0 * x + 0.0025], axis=1))
        length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        assert length == pytest.approx(bend.stretch * 0.040, rel=1e-6)


def test_soft_clamps_have_no_jump_and_pull_backs_and_area_ratios_agree():
    clamp, nudge = np.array([[0.095, 0.03, 0.0025]]), np.array([[1e-10, 0, 0]])
    bend = HINGE.flexure(DESIGN, Bend(50.0))
    assert bend.positions(clamp - nudge) == pytest.approx(bend.positions(clamp + nudge), abs=1e-9)
    flexure = Hinge(give=0.0, transition=0.004, contraction=0.3).flexure(DESIGN, Bend(40.0))
    for clamp in (0.055, 0.095, 0.059, 0.091, 0.075):
        sides = np.array([[clamp - 1e-9, 0.05, 0.004], [clamp + 1e-9, 0.05, 0.004]])
        before, after = flexure.gradient(sides)
        assert before == pytest.approx(after, abs=1e-5)
    rng = np.random.default_rng(5)
    F = np.eye(3) + 0.3 * rng.standard_normal((50, 3, 3))
    F = F[np.linalg.det(F) > 0.1]
    J, inverse = np.linalg.det(F), np.linalg.inv(F)
    tensors = pulled_back_entries(F)[..., WHOLE_TENSOR]
    assert tensors == pytest.approx(pulled_back(F), rel=1e-10)
    normals = rng.standard_normal((len(F), 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    nanson = J[:, None] * np.einsum("nji,nj->ni", inverse, normals)
    assert area_ratio(F, normals) == pytest.approx(np.linalg.norm(nanson, axis=1), rel=1e-12)


def test_one_end_of_a_twist_turns_by_its_angle_against_the_other():
    """Right-handed about x, the middle at rest."""
    x, (_, y, z) = np.array([0.0, 0.075, 0.150]), DESIGN.centre
    places = np.stack([x, np.full(3, y + 0.02), np.full(3, z)], axis=-1)
    moved = Twist(40.0).deformation(DESIGN).positions(places) - (0.0, y, z)
    assert np.degrees(np.arctan2(moved[:, 2], moved[:, 1])) == pytest.approx([-20.0, 0.0, 20.0])


def test_deformations_inside_out_are_refused() -> None:
    shrunk = Displaced(
        lambda x: -0.5 * x, lambda x: np.broadcast_to(-0.5 * np.eye(3), (*x.shape, 3))
    )
    F = Composition(shrunk, shrunk).gradient(np.zeros((4, 3)))
    assert pytest.approx(0.25 * np.eye(3)) == F[0]
    F[2, 0, 0] *= -1.0
    with pytest.raises(ConfigurationError, match="at 1 of 4 points"):
        pulled_back_entries(F)


# The map from a nominal sensor to a specimen


def specimen() -> SensorDesign:
    """Reference sensor with electrodes moved along their sides, and a thicker layer."""
    moves = np.random.default_rng(0).uniform(-1e-3, 1e-3, len(DESIGN.electrodes)).tolist()
    moved = [
        dataclasses.replace(e, **({"x": e.x + by} if e.y in (0.0, 0.06) else {"y": e.y + by}))
        for e, by in zip(DESIGN.electrodes, moves, strict=True)
    ]
    return dataclasses.replace(
        DESIGN, electrodes=tuple(moved), thickness=0.0052, encapsulated_thickness=0.01248
    )


def test_electrodes_of_a_specimen_are_mapped_and_only_where_the_rest_agrees():
    shift = electrode_shift(DESIGN, specimen())
    for one, other in zip(DESIGN.electrodes, specimen().electrodes, strict=True):
        along = np.array([1.0, 0.0, 0.0] if one.y in (0.0, 0.06) else [0.0, 1.0, 0.0])
        for way in (-0.5, 0.0, 0.5):
            at = np.array([one.x, one.y, 0.005]) + way * one.width * along
            expected = np.array([other.x, other.y, 0.0052]) + way * one.width * along
            assert shift.positions(at) == pytest.approx(expected, abs=1e-12)
    x = points()
    assert shift.gradient(x) == pytest.approx(derivative(shift, x), abs=1e-6)
    for axis, end in ((0, 0.0), (0, 0.15), (1, 0.0), (1, 0.06)):
        edge = x.copy()
        edge[:, axis] = end
        assert shift.positions(edge)[:, axis] == pytest.approx(end, abs=1e-15)
    assert shift.map_points(x)[0] is shift.map_points(x)[0]  # all scenes share the points
    first, *others = DESIGN.electrodes
    for change in (
        {"outline": (larger := Rectangle(0.16, 0.06)), "electrodes": uniform(larger, 8)},
        {"electrodes": tuple(others)},
        {"electrodes": DESIGN.electrodes[::-1]},
        {"electrodes": (Electrode(0.05, 0.03, on="top"), *others)},
        {"electrodes": (dataclasses.replace(first, width=0.006), *others)},
    ):
        assert electrode_shift(DESIGN, dataclasses.replace(DESIGN, **change)) is None
    same = electrode_shift(DESIGN, DESIGN)
    assert same.gradient(np.full((1, 3), 0.002)) == pytest.approx(np.eye(3)[None])
