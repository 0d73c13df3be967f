"""Pictures of changes: where, of which sign, and by which regularised inverse."""

from typing import get_args

import numpy as np
import pytest

from eitskin.errors import FrameError, UnusableFrameError
from eitskin.geometry import Disc, Polygon, Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import Frame, Protocol
from eitskin.training import PixelGrid, Reconstructor, Regularisation
from eitskin.training.reconstruction.pixel_grid import figures_of_merit, picture_regions
from eitskin.training.reconstruction.reconstructor import Method, silent_channels, suited_difference
from eitskin.training.reconstruction.regularised_inverse import (
    gauss_newton,
    least_variation,
    prior_matrix,
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_bad_dead_and_stuck_channels_are_left_out_and_wrong_frames_refused(greit):
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
    frame = Frame(np.ones(len(PROTOCOL)), PROTOCOL)
    other = Protocol.opposite(16)
    with pytest.raises(FrameError, match=r"adjacent:16 \(208.*opposite:16"):
        greit.image(Frame(np.ones(len(other)), other), frame)
    with pytest.raises(FrameError, match="got shape"):
        greit.data(np.ones(10), np.ones(208))
    with pytest.raises(FrameError, match="got shape"):
        greit.images(np.ones(10))
    values = np.random.default_rng(0).normal(100.0, 1.0, (6, 5))
    values[:, 1], values[:, 3] = 0.0, 99.0
    assert silent_channels(values).tolist() == [False, True, False, True, False]
    assert silent_channels(values[:1]).tolist() == [False, True, False, False, False]


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


# The regularised inverse


GRID = PixelGrid.from_outline(Rectangle(0.12, 0.06), 72)
RNG = np.random.default_rng(0)
# Channels feel the surroundings of one position each, more or less.
J = -GRID.discs(RNG.uniform((0, 0), (0.12, 0.06), (15, 2)), 0.03) @ np.diag(np.geomspace(1, 3, 72))
TRUTH = GRID.discs([(0.05, 0.03)], 0.015)[0]


def family(name="tikhonov"):
    return gauss_newton(J, prior_matrix(name, GRID, J))


@pytest.mark.parametrize("name", ["tikhonov", "noser", "laplace"])
def test_picture_is_that_of_dense_least_squares(name):
    """|J x - y|^2 + lambda^2 x^T R x, with a root of R written out, by an independent solver."""
    roots = {
        "tikhonov": np.eye(72),
        "noser": np.diag(np.linalg.norm(J, axis=0)),
        "laplace": GRID.differences.toarray(),
    }
    y, parameter = RNG.normal(size=15), 0.7
    stacked = np.concatenate([J, parameter * roots[name]])
    expected = np.linalg.lstsq(stacked, np.concatenate([y, np.zeros(len(roots[name]))]))[0]
    assert family(name).matrix(parameter) @ y == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_noise_figures_are_those_drawn_misfits_kept_and_rules_named():
    inverse, parameter = family(), 0.9
    response = J @ TRUTH
    noise = np.random.default_rng(1).normal(size=(20_000, 15)) @ inverse.matrix(parameter).T
    signal = np.abs(inverse.matrix(parameter) @ response).mean() / np.sqrt(np.mean(noise**2))
    expected = np.abs(response).mean() / signal
    assert inverse.noise_figure(parameter, response) == pytest.approx(expected, rel=0.01)
    chosen = inverse.lambda_from_noise_figure(expected, response)
    assert chosen == pytest.approx(parameter, rel=0.005)
    y, inverse = RNG.normal(size=15), family("laplace")
    parameter = inverse.lambda_from_misfit(1.2, y)
    assert np.linalg.norm(y - J @ inverse.matrix(parameter) @ y) == pytest.approx(1.2, rel=1e-3)
    assert Regularisation.from_text("noise-figure:0.5") == Regularisation("noise-figure", 0.5)
    assert Regularisation.from_text("gcv").rule == "gcv"
    assert Regularisation.from_text("lambda:3").choose(family(), TRUTH, J) == 3.0
    assert Regularisation.from_text("snr:10").choose(
        family(), TRUTH, J
    ) == family().lambda_from_snr(10.0)


def test_cross_validation_is_least_at_its_lambda_on_squares_of_two_millimetres():
    rng = np.random.default_rng(3)
    inverse = family()
    pictures = rng.normal(size=(50, 72))
    y = pictures @ J.T + 2.0 * rng.normal(size=(50, 15))

    def score(parameter):
        left = np.eye(15) - J @ inverse.matrix(parameter)
        return np.sum((y @ left) ** 2) / np.trace(left) ** 2

    found = inverse.lambda_from_gcv(y)
    assert score(found) <= min(score(found * factor) for factor in (0.1, 0.9, 1.1, 10.0))
    # The pictures are drawn from the prior with s = 1, and the noise is 2: lambda = n / s.
    assert found == pytest.approx(2.0, rel=0.15)
    grid = PixelGrid.from_outline(Rectangle(0.150, 0.060))
    assert grid.shape == (30, 75)
    assert len(grid) == 2250
    assert grid.sides == pytest.approx((2e-3, 2e-3))
    assert (grid.x[0], grid.y[-1]) == pytest.approx((1e-3, 59e-3))


# ---- total variation ----


def test_steps_and_slopes_have_closed_forms_and_no_difference_crosses_the_rim():
    """min |x - y|^2 / 2 + alpha TV(x): both plateaus move by alpha over their lengths."""
    grid = PixelGrid(Rectangle(0.04, 0.001), (1, 40))
    y = np.where(np.arange(40) < 10, 1.0, 3.0)
    alpha = 2.0
    misfit = alpha * np.sqrt(1 / 10 + 1 / 30)
    found = least_variation(grid, np.eye(40), y, misfit)
    expected = np.where(np.arange(40) < 10, 1.0 + alpha / 10, 3.0 - alpha / 30)
    assert found == pytest.approx(expected, abs=0.1)  # corners are rounded a little
    assert found[[0, -1]] == pytest.approx(expected[[0, -1]], abs=0.015)
    grid = PixelGrid.from_outline(L_SHAPE, 300)
    x, y = grid.centres.T
    along_x, along_y = (grid.differences @ (3.0 * x - 2.0 * y)).reshape(2, -1)
    for values, expected in ((along_x, 3.0 * grid.sides[0]), (along_y, -2.0 * grid.sides[1])):
        assert values[values != 0.0] == pytest.approx(expected)
    assert (along_x == 0.0).sum() == grid.shape[0]  # the last pixel of every row


# Pixels of rectangles, discs and polygons

L_SHAPE = Polygon(((0, 0), (0.12, 0), (0.12, 0.05), (0.06, 0.05), (0.06, 0.1), (0, 0.1)))


@pytest.mark.parametrize(("outline", "area"), [(Disc(0.05), np.pi * 0.05**2), (L_SHAPE, 0.009)])
def test_mask_has_the_area_of_the_outline(outline, area):
    grid = PixelGrid.from_outline(outline, 4000)
    assert len(grid) * grid.area == pytest.approx(area, rel=0.02)
    picture = grid.image(np.arange(len(grid)))
    assert np.isnan(picture).sum() == picture.size - len(grid)
    assert (picture[grid.inside] == np.arange(len(grid))).all()


def test_many_channels_near_zero_ask_for_absolute_differences():
    some, none = np.where(np.arange(40) % 4, 10.0, 1e-4), np.full(40, 10.0)
    said = [suited_difference(Protocol.adjacent(8), reference) for reference in (some, none)]
    assert said == ["absolute", None]
