"""Presses in 3D against bodies of revolution, balance, energy, symmetry and superposition."""

import numpy as np
import pytest
from scipy.sparse import csc_array

from eitskin.errors import ConfigurationError
from eitskin.geometry import Disc, Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import Cylinder, Mechanics, Touch
from eitskin.simulator.linalg.nested_dissection import Elimination, dissected
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.initial_guess import UnboundedPress
from eitskin.simulator.mechanics.load_stepping import SolidError
from eitskin.simulator.mechanics.materials import NeoHookean
from eitskin.simulator.mechanics.press_3d import PressedStack

OUTLINE = Rectangle(0.080, 0.070)
DESIGN = SensorDesign(OUTLINE, 0.005, uniform(OUTLINE, 4), encapsulated_thickness=0.005)
MATERIAL = Mechanics(NeoHookean(20e3), NeoHookean(20e3), margin=0.0)
PUNCH = Cylinder(0.004)
COARSE = Grading(finest=9e-4, coarsest=5e-3, growth=0.6, layers=2)
COARSER = Grading(finest=2.5e-3, coarsest=6e-3, growth=1.0)
REACH = 0.018


def stack(*touches, grading=COARSE, reach=REACH, design=DESIGN):
    return PressedStack(design, touches, MATERIAL, grading, reach)


def solved(*touches, **how):
    (found,) = stack(*touches, **how).equilibria()
    return found


@pytest.fixture(scope="module")
def alone():
    """In the middle of the sensor, at growing parts of 1 N."""
    return list(stack(Touch(0.040, 0.035, 1.0, PUNCH)).equilibria((0.5, 0.75, 1.0)))


def points(n=4000, low=(0.020, 0.015, 0.0), high=(0.060, 0.055, 0.005)):
    return np.random.default_rng(5).uniform(low, high, (n, 3))


@pytest.mark.slow
def test_far_from_edges_a_press_is_a_body_of_revolution(alone) -> None:
    press = AxisymmetricPress(MATERIAL.stack(DESIGN), PUNCH)
    for force, found in zip((0.5, 0.75, 1.0), alone, strict=True):
        round_ = press.to_force(force)
        assert found.depths[0] == pytest.approx(round_.depth, rel=0.04)
        assert found.thinnings[0] == pytest.approx(round_.thinning(0), rel=0.04)
    area = np.pi * round_.contact_radius**2
    assert found.contact_areas[0] == pytest.approx(area, rel=0.1)
    assert found.mean_pressures[0] == found.forces[0] / found.contact_areas[0]
    assert found.peak_pressures[0] > found.mean_pressures[0]
    # Beside the indenter, half way up and at the top; the window ends at 18 mm.
    r = np.linspace(0.006, 0.012, 13)
    for height in (0.0025, 0.005):
        level = np.argmin(np.abs(round_.z - height))
        expected = np.stack(
            [np.interp(r, round_.r, round_.displacement[:, level, k]) for k in (0, 1)], axis=1
        )
        for x, y in ((1.0, 0.0), (0.6, 0.8)):
            X = np.stack([0.040 + x * r, 0.035 + y * r, np.full_like(r, height)], axis=1)
            u = found.positions(X) - X
            moved = np.stack([u[:, 0] * x + u[:, 1] * y, u[:, 2]], axis=1)
            assert np.linalg.norm(moved - expected) < 0.12 * np.linalg.norm(expected)


@pytest.mark.slow
def test_the_base_carries_the_force_whose_work_is_the_energy(alone) -> None:
    for fraction, found in zip((0.5, 0.75, 1.0), alone, strict=True):
        assert found.forces == pytest.approx([fraction], rel=1e-9)
        assert found.base_force == pytest.approx(fraction, rel=1e-6)
    # Simpson's rule over the force: dU = d(F d) - d dF.
    depths = [found.depths[0] for found in alone]
    complementary = 0.5 / 6 * (depths[0] + 4 * depths[1] + depths[2])
    work = 1.0 * depths[2] - 0.5 * depths[0] - complementary
    assert alone[2].energy - alone[0].energy == pytest.approx(work, rel=5e-3)


@pytest.mark.slow
def test_gradient_is_the_derivative_of_positions_and_keeps_volume(alone) -> None:
    assert alone[-1].volume_ratio == pytest.approx(1.0, abs=1e-4)
    J = np.linalg.det(alone[-1].gradient(points()))
    assert J.mean() == pytest.approx(1.0, abs=5e-3)
    assert np.sqrt(np.mean((J - 1.0) ** 2)) < 0.03
    X = points(500)
    steps = 1e-8 * np.eye(3)
    ends = [alone[-1].positions(X + e) - alone[-1].positions(X - e) for e in steps]
    # Where a difference straddles two cells, it is of neither.
    error = np.abs(alone[-1].gradient(X) - np.stack(ends, axis=-1) / 2e-8).max(axis=(1, 2))
    assert np.quantile(error, 0.97) < 1e-6


@pytest.mark.slow
def test_what_lies_beyond_the_window_does_not_move(alone) -> None:
    X = np.array([[0.001, 0.035, 0.005], [0.079, 0.001, 0.0]])
    assert np.array_equal(alone[-1].positions(X), X)
    assert np.array_equal(alone[-1].gradient(X), np.broadcast_to(np.eye(3), (2, 3, 3)))
    edge = np.array([0.060, 0.035, 0.005])
    step = np.array([1e-9, 0.0, 0.0])
    across = alone[-1].positions(edge + step) - alone[-1].positions(edge - step)
    assert across == pytest.approx(2.0 * step, abs=1e-10)
    with pytest.raises(ConfigurationError, match="outside"):
        alone[-1].positions(np.array([0.040, 0.035, 0.006]))


@pytest.mark.slow
def test_half_of_a_symmetric_press_is_like_all_of_it() -> None:
    """A micrometre beside the middle nothing mirrors itself."""
    outline = Rectangle(0.020, 0.020)
    small = SensorDesign(outline, 0.005, uniform(outline, 4), encapsulated_thickness=0.005)
    how = {"grading": COARSER, "design": small}
    half = stack(Touch(0.010, 0.010, 0.5, PUNCH), **how)
    assert [window.mirrored for window in half.windows] == [True, True]
    whole = stack(Touch(0.010 + 1e-6, 0.010, 0.5, PUNCH), **how)
    assert [window.mirrored for window in whole.windows] == [False, True]
    (one,), (other,) = whole.equilibria(), half.equilibria()
    assert one.depths == pytest.approx(other.depths, rel=1e-3)
    assert one.energy == pytest.approx(other.energy, rel=1e-3)
    X = points(300, (0.0, 0.0, 0.0), (0.020, 0.020, 0.005))
    assert one.positions(X) == pytest.approx(other.positions(X), abs=5e-6)


@pytest.mark.slow
def test_touches_near_opposite_corners_are_mirror_images() -> None:
    near, far = (
        solved(Touch(x, y, 0.4, PUNCH), grading=COARSER, reach=0.008)
        for x, y in ((0.007, 0.006), (0.073, 0.064))
    )
    assert near.depths == pytest.approx(far.depths, rel=1e-6)
    X = points(300, (0.0, 0.0, 0.0), (0.015, 0.015, 0.005))
    turned = np.array([0.080, 0.070, 0.0]), np.array([-1.0, -1.0, 1.0])
    there = far.positions(turned[0] + turned[1] * X)
    assert turned[0] + turned[1] * there == pytest.approx(near.positions(X), abs=1e-9)


@pytest.mark.slow
def test_presses_far_apart_add_up() -> None:
    touches = (Touch(0.025, 0.035, 0.5, PUNCH), Touch(0.055, 0.035, 0.5, PUNCH))
    one = solved(Touch(0.040, 0.035, 0.5, PUNCH), grading=COARSER)
    both = solved(*touches, grading=COARSER)
    assert both.windows[0].mirrored
    assert both.windows[1].mirrored
    assert both.forces == pytest.approx([0.5, 0.5], rel=1e-9)
    assert both.base_force == pytest.approx(1.0, rel=1e-6)
    assert both.depths == pytest.approx([one.depths[0]] * 2, rel=0.01)
    assert both.energy == pytest.approx(2.0 * one.energy, rel=0.02)


@pytest.mark.slow
def test_unequal_touches_each_carry_their_own_force() -> None:
    light, heavy = Touch(0.032, 0.035, 0.3, PUNCH), Touch(0.048, 0.035, 0.6, PUNCH)
    pair = stack(light, heavy, grading=COARSER, reach=0.008)
    assert [window.mirrored for window in pair.windows] == [False, True]
    (found,) = pair.equilibria()
    assert found.forces == pytest.approx([0.3, 0.6], rel=1e-9)
    assert found.base_force == pytest.approx(0.9, rel=1e-6)
    assert len(found.depths) == len(found.thinnings) == 2


def test_what_cannot_be_pressed_is_refused() -> None:
    near = (Touch(0.040, 0.035, 1.0, PUNCH), Touch(0.046, 0.035, 1.0, PUNCH))
    for touches, message in (
        ((Touch(0.081, 0.035),), "on the sensor"),
        (near, "must not overlap"),
        ((), "one to 4 touches"),
        ((Touch(0.040, 0.035, depth=1e-3),), "leave both out"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            stack(*touches)
    with pytest.raises(ConfigurationError, match="fractions"):
        list(stack(Touch(0.040, 0.035, 1.0, PUNCH)).equilibria((0.0,)))
    disc = Disc(0.050)
    with pytest.raises(ConfigurationError, match="rectangular"):
        PressedStack(SensorDesign(disc, 0.005, uniform(disc, 4)), (Touch(0.025, 0.025),))


def test_a_press_too_hard_says_how_much_is_carried(monkeypatch) -> None:
    def least(stack, touch, force):
        if force > 0.3:
            raise SolidError("it would crease")
        return on(stack, touch, force)

    on = UnboundedPress.on
    monkeypatch.setattr(UnboundedPress, "on", least)
    with pytest.raises(SolidError, match=r"carries \d+%") as refusal:
        solved(Touch(0.040, 0.035, 0.6, PUNCH), grading=COARSER, reach=0.009)
    assert 0.48 < refusal.value.reached <= 0.5


def test_elimination_by_blocks_is_that_of_the_whole_matrix() -> None:
    """On a grid whose unknowns know of their neighbours only, and one that knows of all."""
    lines = (np.arange(8.0), np.arange(6.0))
    places = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 2)
    places = np.repeat(np.concatenate([places, [[np.nan, np.nan]]]), 2, axis=0)
    rng = np.random.default_rng(1)
    A = rng.normal(size=(len(places), len(places)))
    apart = np.abs(places[:, None] - places).max(axis=-1)
    A = np.where(apart > 1.0, 0.0, A + A.T)
    blocks = dissected(places, lines)
    assert np.array_equal(np.sort(np.concatenate([b.own for b in blocks])), np.arange(len(A)))
    assert len(blocks) > 8
    eliminated = Elimination(csc_array(A), blocks)
    right = rng.normal(size=len(A))
    assert A @ eliminated.solve(right) == pytest.approx(right, abs=1e-9)
    assert eliminated.negative == np.count_nonzero(np.linalg.eigvalsh(A) < 0.0)
