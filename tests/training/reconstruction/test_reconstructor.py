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
from eitskin.simulator import Scene, Simulator
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.reconstruction.linear_model import linear_model
from eitskin.training.reconstruction.pixel_grid import figures_of_merit
from eitskin.training.reconstruction.reconstructor import (
    Method,
    Reconstructor,
    silent_channels,
)
from eitskin.training.reconstruction.regions import picture_regions

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


def test_data_do_not_know_the_unit_of_the_frames(greit):
    """Nor a gain of the board: absolute differences fit one factor, relative ones need none."""
    before = np.asarray(greit.model.impedance)
    after = before + greit.model.sensitivity[:, 300]
    expected = greit.data(after, before)
    assert expected == pytest.approx(np.real(after - before) / np.sqrt(np.mean(before.real**2)))
    for gain in (1e-3, -20.0, np.exp(0.3j)):
        assert greit.data(gain * after, gain * before) == pytest.approx(expected)
    relative = made()
    gains = np.random.default_rng(0).uniform(0.5, 2.0, len(PROTOCOL))
    assert relative.data(gains * after, gains * before) == pytest.approx(
        np.real((after - before) / before)
    )


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


def test_channels_near_zero_are_compared_on_one_scale_and_mirrored_places_are_told():
    """A disc looks the same from r and -r where opposite electrodes drive, and opposite ones sense.

    Readings of driven electrodes, whose contacts say most, are left out beside others.
    """
    assert Reconstructor(SensorDesign.reference()).difference == "relative"
    assert (made().difference, made().ambiguous_share) == ("relative", 0.0)
    facing = Protocol.skip(16, 7, sense_skip=7)
    maker = Reconstructor(DESIGN, facing, pixels=625, resolution=COARSE)
    assert maker.difference == "absolute"
    assert maker.ambiguous_share > 0.9
    driven = Protocol.adjacent(16, shared=True)
    maker = Reconstructor(DESIGN, driven, pixels=625, resolution=COARSE)
    before = np.real(maker.model.impedance)
    missing = np.isnan(maker.data(1.01 * before, before))
    assert missing.tolist() == list(driven.shares)
    assert np.isfinite(maker.images(maker.data(1.01 * before, before))[maker.grid.inside]).all()


@pytest.mark.parametrize("method", ["total-variation", "greit"])
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


# ---- linear model ----


COARSEST = ((2, 1), Grading(finest=4e-3, coarsest=8e-3, growth=1.0, layers=1))
THREE = Protocol(((0, 1, 0, 1), (2, 6, 2, 6), (0, 4, 1, 3)), 8)
LAYOUT = InputSpec(SensorDesign.reference(), THREE, 40e3, np.ones(3))


@pytest.mark.slow
def test_agrees_with_central_differences():
    """The relative change of every measurement, for a gel that conducts a little more somewhere."""
    simulator = Simulator(LAYOUT.design, COARSEST, protocol=THREE)
    setting = simulator.deformed_layer(Scene())

    def change(x, y):
        return np.sin(20.0 * x) + np.cos(40.0 * y)

    def logarithms(share):
        def conductivity(x):
            factor = 1.0 + share * change(x[..., 0], x[..., 1])
            return setting.conductivity(x) * factor[..., None, None]

        impedance = simulator.model.impedance(conductivity, setting.area_ratio)
        return np.log(THREE.measure(impedance).real)

    rows, columns = LAYOUT.pixels
    y, x = ((np.arange(n) + 0.5) / n * size for n, size in ((rows, 0.06), (columns, 0.15)))
    J = linear_model(LAYOUT.design, THREE, LAYOUT.pixels, COARSEST).relative
    assert J.shape == (3, rows * columns)
    expected = (logarithms(1e-4) - logarithms(-1e-4)) / 2e-4
    # The difference that is left is that of pixels and a smooth change.
    assert J @ change(*np.meshgrid(x, y)).ravel() == pytest.approx(expected, rel=5e-3)
