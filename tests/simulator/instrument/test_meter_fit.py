"""Fits of the four-terminal meter: parameters found again, and those that nothing shows."""

import dataclasses

import numpy as np
import pytest

from eitskin.errors import ConfigurationError, DataError
from eitskin.simulator import FourTerminalMeter, Protocol
from eitskin.simulator.instrument.fit_parameters import FIT_PARAMETERS, Parameter
from eitskin.simulator.instrument.meter_fit import agreement, fit_meter, select_meter

RIG = FourTerminalMeter(sink=3e-3, sense_plus=8e-4, idle=5e-4, scale=12.0, reads="magnitude")
DRIVES, SENSES = ((0, 3), (3, 0), (1, 4), (5, 2)), ((1, 2), (4, 5), (5, 1), (4, 2))
BOTH = Protocol(
    (
        *(d + s for d in DRIVES for s in SENSES if not set(d) & set(s)),
        *((0, 1, 2, 3), (2, 3, 0, 1), (4, 5, 0, 2), (1, 0, 4, 5)),
        *((2, 4, 0, 5), (4, 2, 3, 1), (0, 5, 1, 3)),
    ),
    6,
)


@pytest.fixture(scope="module")
def skin():
    """Impedance matrix of a random network of six electrodes [ohm]."""
    rng = np.random.default_rng(1)
    Y = np.zeros((6, 6))
    for i in range(6):
        for j in range(i):
            g = rng.uniform(1e-3, 5e-3)
            Y[[i, j], [i, j]] += g
            Y[[i, j], [j, i]] -= g
    return np.linalg.pinv(Y)


def flat_frames(meter, skin, noise=0.0, seed=0, count=40):
    """Frames with white noise of this share of the largest reading."""
    true, _ = meter.reading(meter.transfer_impedance(skin, BOTH))
    rng = np.random.default_rng(seed)
    scatter = rng.standard_normal((2, count, len(BOTH))) * noise * np.abs(true).max()
    return true + scatter[0] + (1j * scatter[1] if meter.reads == "complex" else 0.0)


def test_loads_of_a_board_of_magnitudes_are_found_with_their_errors(skin):
    terms = ("sink", "sense_plus", "idle")
    found = fit_meter(skin, BOTH, flat_frames(RIG, skin, 1e-3), terms, starts=4)
    assert found.meter.reads == "magnitude"
    true = np.array([3e-3, 8e-4, 5e-4])
    assert (np.abs(found.values - true) < 4.0 * found.standard_errors).all()
    assert (found.standard_errors < 0.02 * true).all()
    assert found.meter.scale == pytest.approx(12.0, abs=4.0 * 12.0 * found.scale_error)
    assert not found.tied
    ideal = fit_meter(skin, BOTH, flat_frames(RIG, skin), ())
    assert agreement(found.predicted, found.measured).r > 0.9999
    assert agreement(ideal.predicted, ideal.measured).residual > 0.05


def test_complex_readings_give_capacitances_and_the_phase_of_the_scale(skin):
    rig = FourTerminalMeter(sink=2e-3 + 1e-3j, idle=4e-4j, scale=2.0 * np.exp(0.4j))
    frames = flat_frames(rig, skin, 1e-6)
    found = fit_meter(skin, BOTH, frames, ("sink", "idle"), starts=4).meter
    assert found.sink == pytest.approx(rig.sink, rel=0.02)
    assert found.idle == pytest.approx(rig.idle, rel=0.02)
    assert found.scale == pytest.approx(rig.scale, rel=0.01)


@pytest.mark.slow
def test_leads_leaks_common_mode_and_offset_are_found(skin):
    rig = dataclasses.replace(
        RIG, reads="signed", common_mode=0.4, offset=30.0, leaks=(1e-3, 0, 0, 2e-3, 0, 0)
    )
    frames = flat_frames(rig, skin, 1e-6)
    found = fit_meter(skin, BOTH, frames, ("leaks", "common_mode", "offset", "sink"), starts=2)
    assert found.meter.leaks[3] > found.meter.leaks[0] > max(found.meter.leaks[1:3])
    exact = dataclasses.replace(rig, sense_plus=0.0, idle=0.0)
    found = fit_meter(
        skin, BOTH, flat_frames(exact, skin), ("leaks", "common_mode", "offset", "sink"), starts=3
    ).meter
    assert found.leaks == pytest.approx(exact.leaks, abs=1e-5)
    assert (found.common_mode, found.offset, found.scale) == pytest.approx((0.4, 30.0, 12.0), 1e-3)


def test_what_no_reading_shows_is_said_not_to_be_identifiable(skin):
    # A current through two loads has no other way back: only their sum in series shows.
    rig = FourTerminalMeter(sink=2e-3, sense_minus=1e-3, scale=5.0, reads="signed")
    found = fit_meter(skin, BOTH, flat_frames(rig, skin, 1e-5), ("sink", "sense_minus"), starts=2)
    assert not np.isfinite(found.standard_errors).any()
    assert found.tied == (("sink", "sense_minus"),)
    assert (1.0 / found.values).sum() == pytest.approx(1500.0, rel=0.01)
    # One load alone has none, but says where ground is.
    frames = flat_frames(FourTerminalMeter(scale=5.0, reads="signed"), skin, 1e-4)
    found = fit_meter(skin, BOTH, frames, ("sink", "common_mode"), starts=2)
    assert np.isfinite(found.standard_errors).tolist() == [False, True]


@pytest.mark.slow
def test_terms_that_the_frames_do_not_call_for_are_left_out(skin):
    terms = ("sink", "sense_plus", "idle", "common_mode")
    rig = dataclasses.replace(RIG, sense_plus=0.0, reads="signed")
    found = select_meter(skin, BOTH, flat_frames(rig, skin, 1e-4), terms, starts=2)
    assert {"sink", "idle"} <= {str(each) for each in found.parameters}
    assert len(found.parameters) < len(terms)
    assert found.meter.sink == pytest.approx(3e-3, rel=0.3)
    assert np.isfinite(found.standard_errors).all()


def test_frames_and_terms_that_do_not_fit_are_refused(skin):
    frames = flat_frames(RIG, skin)
    with pytest.raises(ConfigurationError, match=r"among .*source.*, got souce"):
        fit_meter(skin, BOTH, frames, ("souce",))
    with pytest.raises(ConfigurationError, match=r"parameters cannot be fitted to \d+ readings"):
        fit_meter(skin, BOTH, frames, FIT_PARAMETERS)
    with pytest.raises(DataError, match=r"channels, got shape"):
        fit_meter(skin, BOTH, frames[:, 1:])
    with pytest.raises(DataError, match="finite"):
        fit_meter(skin, BOTH, np.where(frames > 0, np.nan, frames))
    with pytest.raises(DataError, match="zero"):
        fit_meter(skin, BOTH, 0.0 * frames)


@pytest.mark.parametrize(("transform", "scale"), [("factor", 1.0), ("linear", 3.0), ("share", 9.0)])
def test_coordinates_are_those_of_the_numbers_and_slopes_their_derivatives(transform, scale):
    parameter = Parameter("sink", 2.0, 0.3, transform, scale=scale)
    for x in (-0.5, 0.2, 1.5):
        assert parameter.coordinate(parameter.number(x)) == pytest.approx(x, rel=1e-12)
        rise = parameter.number(x + 1e-5) - parameter.number(x - 1e-5)
        assert parameter.slope(x) == pytest.approx(rise / 2e-5, rel=1e-7)
