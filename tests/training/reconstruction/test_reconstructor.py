"""Pictures of a disc and of the reference sensor by every method."""

from typing import get_args

import numpy as np
import pytest

from eitskin.errors import FrameError, UnusableFrameError
from eitskin.frame import Frame
from eitskin.geometry import SensorDesign
from eitskin.geometry.design.outline import Disc
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.meshing.grading import Grading
from eitskin.protocol import Protocol
from eitskin.training.reconstruction.pixel_grid import figures_of_merit, picture_regions
from eitskin.training.reconstruction.reconstructor import (
    Method,
    Reconstructor,
    silent_channels,
)

RADIUS = 0.05
COARSE = ((2, 1), Grading(4e-3, 0.02, 1.5, layers=1))
OUTLINE = Disc(RADIUS)
DESIGN = SensorDesign(OUTLINE, 0.005, uniform(OUTLINE, 16))
PROTOCOL = Protocol.adjacent(16)


def made(method="greit", **options):
    return Reconstructor(DESIGN, PROTOCOL, method, pixels=625, resolution=COARSE, **options)


@pytest.fixture(scope="module")
def greit():
    return made(difference="absolute")


@pytest.mark.parametrize("method", get_args(Method))
def test_every_method_shows_a_change_where_it_is_and_with_its_sign(method):
    """For relative differences, the default here, as well as for absolute ones."""
    makers = made(method), made(method, difference="absolute")
    for maker, most in zip(makers, (0.14, 0.1), strict=True):
        found = merit_of(maker)
        assert found.position_error < most * RADIUS


def merit_of(maker):
    place = (0.065, 0.06)
    picture = -0.1 * maker.grid.discs([place], 0.008)[0]
    shown = maker.images(maker.jacobian @ picture)
    assert shown.shape == maker.grid.shape
    assert (np.isnan(shown) == ~maker.grid.inside).all()
    return figures_of_merit(shown[maker.grid.inside], maker.grid, place, -1e-4)


def test_bad_channels_are_left_out(greit):
    before = np.asarray(greit.model.impedance)
    after = before * (1.0 + 0.01 * np.sin(np.arange(len(PROTOCOL))))
    status = np.zeros(len(PROTOCOL), np.uint8)
    status[[3, 50]] = 1
    spoiled = after.astype(complex)
    spoiled[3] = np.nan
    shown = greit.image(Frame(spoiled, PROTOCOL, status=status), Frame(before, PROTOCOL))
    data = greit.data(after, before)
    family = greit.family.drop_channels(status != 0)
    expected = family.matrix(greit.choose_lambda()) @ data[status == 0]
    assert shown[greit.grid.inside] == pytest.approx(expected)
    status[: len(status) // 2 + 1] = 1
    with pytest.raises(UnusableFrameError, match="50%"):
        greit.image(Frame(after, PROTOCOL, status=status), Frame(before, PROTOCOL))


def test_wrong_frames_are_refused(greit):
    frame = Frame(np.ones(len(PROTOCOL)), PROTOCOL)
    other = Protocol.opposite(16)
    with pytest.raises(FrameError, match=r"adjacent:16 \(208.*opposite:16"):
        greit.image(Frame(np.ones(len(other)), other), frame)
    with pytest.raises(FrameError, match="got shape"):
        greit.data(np.ones(10), np.ones(208))
    with pytest.raises(FrameError, match="got shape"):
        greit.images(np.ones(10))


@pytest.mark.parametrize(
    "method", [pytest.param("total-variation", marks=pytest.mark.slow), "greit"]
)
def test_regions_are_found_by_their_sign_place_and_size(method):
    """None of the other sign where there is none."""
    maker = made(method)
    low, high = (0.068, 0.05), (0.032, 0.05)
    discs = maker.grid.discs([low, high], 0.012)
    shown = maker.images(maker.jacobian @ (0.4 * discs[1] - 0.5 * discs[0]))
    found = picture_regions(shown, maker.grid)
    assert sorted(region.sign for region in found) == [-1, 1]
    for region in found:
        assert region.centre == pytest.approx(low if region.sign < 0 else high, abs=2e-3)
        assert 0.8 < region.area / (np.pi * 0.012**2) < 1.4
    (one,) = picture_regions(maker.images(maker.jacobian @ (-0.5 * discs[0])), maker.grid)
    assert one.sign == -1


def test_mirrored_places_are_told_and_channels_near_zero_compared_on_one_scale():
    """A disc looks the same from r and -r where opposite electrodes drive and sense."""
    facing = Protocol.skip(16, 7, sense_skip=7)
    maker = Reconstructor(DESIGN, facing, pixels=625, resolution=COARSE)
    assert (maker.difference, maker.ambiguous_share > 0.9) == ("absolute", True)
    assert (made().difference, made().ambiguous_share) == ("relative", 0.0)
    before = np.asarray(maker.model.impedance)
    after = before * (1.0 + 0.01 * np.sin(np.arange(len(before))))
    assert maker.data(abs(after), abs(before)) == pytest.approx(maker.data(after, before))


def test_dead_and_stuck_channels_are_silent():
    values = np.random.default_rng(0).normal(100.0, 1.0, (6, 5))
    values[:, 1], values[:, 3] = 0.0, 99.0
    assert silent_channels(values).tolist() == [False, True, False, True, False]
    assert silent_channels(values[:1]).tolist() == [False, True, False, False, False]


@pytest.mark.parametrize("method", ["greit", "back-projection", "total-variation"])
def test_noise_is_that_of_differences_of_untouched_frames(method):
    maker, rng = made(method), np.random.default_rng(2)
    still = 1e-3 * rng.normal(size=(401, len(PROTOCOL))) + np.linspace(0.0, 0.01, 401)[:, None]
    still[:, 7] = np.nan
    if method == "total-variation":
        assert maker.noise(still) == pytest.approx(made("laplace").noise(still), nan_ok=True)
        return
    images = maker.images(np.diff(still, axis=0))
    ratio = maker.noise(still)[maker.grid.inside] / images[:, maker.grid.inside].std(axis=0)
    assert np.median(ratio) == pytest.approx(1.0, abs=0.05)
    assert np.isnan(maker.noise(still[:4])).all()
