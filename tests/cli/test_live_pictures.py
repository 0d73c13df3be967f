"""Pictures of the live loop: reference, colour scale, and pipelines that carry them."""

import base64
import dataclasses

import numpy as np
import pytest

from eitskin.cli.live_pictures import CALM, REFERENCE, LivePictures
from eitskin.cli.page.live_page import signed_pixels
from eitskin.errors import ConfigurationError, FrameError
from eitskin.geometry import SensorDesign
from eitskin.simulator import Frame, Protocol
from eitskin.training import Reconstructor

from live_fakes import FakePipeline

PROTOCOL = Protocol.pairwise(8)


@pytest.fixture(scope="module")
def maker():
    return Reconstructor(SensorDesign.reference(), method="noser", pixels=200, resolution="coarse")


@pytest.fixture(scope="module")
def flat(maker):
    return np.asarray(maker.model.impedance, dtype=complex)


def frames(flat, session=1, noise=1e-5):
    rng = np.random.default_rng(session)
    drawn = flat * (1.0 + noise * rng.normal(size=(REFERENCE, len(flat))))
    return [Frame(each, PROTOCOL, session=session) for each in drawn]


@pytest.mark.slow
def test_pictures_begin_after_the_reference_of_each_session_and_are_calm_untouched(maker, flat):
    """The ends of the colour scale lie far above the noise of the pictures."""
    pictures = LivePictures(maker)
    for frame in frames(flat):
        assert pictures.picture(frame) is None
    change = -0.01 * maker.grid.discs([(0.05, 0.03)], 0.01)[0]
    touched = Frame(flat * (1.0 + maker.jacobian @ change), PROTOCOL, session=1)
    shown = pictures.picture(touched)
    y, x = np.unravel_index(np.nanargmin(shown.values), shown.values.shape)
    assert np.hypot(maker.grid.x[x] - 0.05, maker.grid.y[y] - 0.03) < 0.012
    assert shown.limit == pytest.approx(np.nanmax(np.abs(shown.values)))
    again = dataclasses.replace(touched, session=2)
    assert pictures.picture(again) is None
    assert pictures.taken == 1
    pictures = LivePictures(maker)
    for frame in frames(flat):
        pictures.picture(frame)
    calm = pictures.picture(frames(flat, noise=1e-5)[3])
    assert np.sqrt(np.nanmean(calm.values**2)) < 2.0 * calm.limit / CALM
    assert signed_pixels(None) is None
    shown = pictures.picture(Frame(1.01 * flat, PROTOCOL, session=1))
    sent = signed_pixels(shown)
    levels = np.frombuffer(base64.b64decode(sent["data"]), np.uint8)
    assert (sent["rows"], sent["columns"]) == maker.grid.shape
    assert levels.min() == 1  # a resistance that rises everywhere: nothing but less conductive
    assert sent["limit"] == pytest.approx(shown.limit, abs=1e-8)


def test_pictures_are_alone_beside_estimates_or_refused(maker, flat):
    pipeline = LivePictures(maker)
    estimates = [pipeline.process(frame) for frame in frames(flat)]
    assert estimates[2].state == f"reference 3/{REFERENCE}"
    assert not estimates[-1].touch_map.any()
    estimate = pipeline.process(Frame(1.01 * flat, PROTOCOL, session=1))
    assert estimate.state == "picture"
    assert estimate.touch_map.shape == maker.grid.shape
    assert 0.0 <= estimate.touch_map.min() < estimate.touch_map.max() <= 1.0
    assert (estimate.bend_angle_deg, estimate.touches) == (None, None)
    fake = FakePipeline()
    pipeline = LivePictures(maker, fake)
    first, *_, last = [
        pipeline.process(frame) for frame in (*frames(flat), Frame(flat, PROTOCOL, session=1))
    ]
    assert first.picture is None
    assert (last.state, last.touches) == (fake.estimate.state, fake.estimate.touches)
    assert last.picture.values.shape == maker.grid.shape
    bad = Frame(flat, PROTOCOL, session=1, status=np.ones(28))
    assert pipeline.process(bad) is fake.estimate
    varied = Reconstructor(SensorDesign.reference(), method="total-variation")
    with pytest.raises(ConfigurationError, match="takes seconds"):
        LivePictures(varied)
    other = Protocol.adjacent(8)
    with pytest.raises(FrameError, match="name the protocol"):
        LivePictures(maker).picture(Frame(np.ones(len(other)), other))
