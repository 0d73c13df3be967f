"""Smooth fields: polynomials exactly, their derivatives, mirror images, stretched axes."""

import numpy as np
import pytest

from eitskin.simulator.presses.fields.smooth_field import Box, SmoothField, together

BOX = Box((-0.01, 0.0, 0.001), (0.05, 0.03, 0.004))


def polynomial(points):
    """Polynomials of degrees 3, 2 and 1 in x, y and z, four components, (..., 4)."""
    x, y, z = np.moveaxis(1e2 * points, -1, 0)
    return np.stack([x**3 * y**2 * z - 2.0 * y, 1.0 + x * z, x * y, z - x], axis=-1)


def columns(count, heights, box=BOX, seed=0):
    rng = np.random.default_rng(seed)
    places = rng.uniform(box.low[:2], box.high[:2], (count, 2))
    found = np.empty((count, len(heights), 3))
    found[..., :2], found[..., 2] = places[:, None], heights
    return found


def grid(box=BOX):
    x, y = np.meshgrid(*(np.linspace(box.low[k], box.high[k], 7) for k in (0, 1)))
    found = np.empty((x.size, 2, 3))
    found[..., 0], found[..., 1], found[..., 2] = (
        x.ravel()[:, None],
        y.ravel()[:, None],
        (2e-3, 3e-3),
    )
    return found


def layers():
    """Columns of two layers of cells in turn."""
    found = columns(20, (0.0011, 0.0021))
    found[::2, :, 2] += 0.0015
    return found


def uneven():
    """Columns that begin at one height and end at as many as there are columns."""
    found = columns(30, (0.0011, 0.0021))
    found[:, 1, 2] += np.random.default_rng(2).uniform(0.0, 0.001, len(found))
    return found


@pytest.mark.parametrize(
    "at",
    [columns(20, (0.001, 0.002, 0.004)), grid(), layers(), uneven()],
    ids=["any", "grid", "layers", "uneven"],
)
def test_polynomials_are_met_everywhere(at) -> None:
    field = SmoothField.of(polynomial, BOX, (4, 3, 2))
    assert field.values(at) == pytest.approx(np.moveaxis(polynomial(at), -1, 0).swapaxes(1, 2))
    single = at.reshape(-1, 1, 3)[np.random.default_rng(1).permutation(at.shape[0] * at.shape[1])]
    assert field.values(single)[:, 0] == pytest.approx(polynomial(single[:, 0]).T)


@pytest.mark.parametrize(
    "at", [columns(9, (0.0015, 0.003)), layers(), uneven()], ids=["any", "layers", "uneven"]
)
def test_derivatives_are_those_of_the_values(at) -> None:
    field = SmoothField.of(polynomial, BOX, (7, 4, 3), stretch=1.5)
    moved = field.moved(at)
    assert moved[:3] == pytest.approx(field.values(at)[:3])
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        slope = (field.values(at + step) - field.values(at - step))[:3] / 2e-6
        assert moved[3:].reshape(3, 3, *slope.shape[1:])[:, axis] == pytest.approx(slope, rel=1e-5)


@pytest.mark.parametrize("stretch", [0.0, 2.0])
def test_smooth_functions_converge_geometrically(stretch) -> None:
    def wave(points):
        return np.exp(np.sin(60.0 * points[..., :1] + 40.0 * points[..., 1:2]))

    at, errors = columns(200, (0.002, 0.003)), []
    exact = np.moveaxis(wave(at), -1, 0).swapaxes(1, 2)
    for degree in (5, 10, 15):
        field = SmoothField.of(wave, BOX, (degree, degree, 2), stretch)
        errors.append(np.abs(field.values(at) - exact).max())
    assert errors[1] < 0.1 * errors[0]
    assert errors[2] < 0.1 * errors[1]


def test_a_field_ends_with_its_length() -> None:
    field = SmoothField.of(polynomial, BOX, (4, 3, 2))
    at = np.array([[[-0.02, 0.01, 0.002]], [[0.06, 0.01, 0.002]]])
    assert np.all(field.values(at) == 0.0)
    assert np.all(field.moved(at) == 0.0)


@pytest.mark.parametrize("axis", [0, 1])
def test_mirror_images_have_mirrored_values(axis) -> None:
    field = SmoothField.of(polynomial, BOX, (4, 3, 2), stretch=1.0)
    at = columns(12, (0.002, 0.003))
    mirrored = at.copy()
    mirrored[..., axis] = 2.0 * 0.07 - at[..., axis]
    signs = np.ones(4)
    signs[axis] = -1.0
    image = field.mirrored(axis, 0.07)
    assert image.values(mirrored) == pytest.approx(signs[:, None, None] * field.values(at))


def test_fields_on_one_box_are_added_up() -> None:
    rng = np.random.default_rng(3)
    near, far = (Box((low, 0.0, 0.0), (low + 0.1, 0.06, 0.005)) for low in (0.0, 0.05))
    fields = [SmoothField(box, rng.normal(size=(4, 3, 2, 4))) for box in (near, far, near)]
    merged = together(fields)
    assert [field.box for field in merged] == [near, far]
    columns = rng.uniform((0, 0, 0), (0.15, 0.06, 0.005), (50, 1, 3))
    expected = sum(field.moved(columns) for field in fields)
    assert sum(field.moved(columns) for field in merged) == pytest.approx(expected, abs=1e-9)
