"""The AD5940's conversion: ranges, clipping, codes, and what an extreme impedance reads as."""

import dataclasses

import numpy as np
import pytest

from eitskin.simulator import Instrument, Protocol, Status
from eitskin.simulator.instrument.ad5940 import (
    CODES,
    PGA_RANGES,
    clipped_fundamental,
    drive_current,
    quantise,
)

ONE = Protocol.pairwise(2)


def only(**terms):
    return dataclasses.replace(Instrument(snr_db=0.0), **terms)


def read_one(instrument, impedance):
    """Reading and status of one pair."""
    rng = np.random.default_rng(0)
    session = instrument.session(ONE, 850.0, rng)
    Z, status = session.measure(np.array([[complex(impedance)]]), np.zeros(1), rng)
    return Z[0, 0], status[0, 0]


def test_codes_are_steps_impedances_their_ratio_and_cut_sines_lose_fundamental():
    rng = np.random.default_rng(5)
    phasors = rng.uniform(-0.6, 0.6, 20000) + 1j * rng.uniform(-0.6, 0.6, 20000)
    step = 0.9 / 2**17
    found = quantise(phasors, np.full(20000, 0.9))
    codes = np.array([found.real, found.imag]) / step
    np.testing.assert_allclose(codes, np.round(codes), atol=1e-9)
    error = np.array([(found - phasors).real, (found - phasors).imag]) / step
    assert np.abs(error).max() <= 0.5 + 1e-9
    np.testing.assert_allclose(error.std(axis=1), 1 / np.sqrt(12), rtol=0.02)
    np.testing.assert_allclose(np.histogram(error, 5, (-0.5, 0.5))[0] / 40000, 0.2, atol=0.01)
    Z = 480.0 * np.exp(-0.02j)
    found, status = read_one(only(quantisation=True), Z)
    through = 0.607 / Z * 200.0
    step_v = 0.9 / CODES
    step_i = min(each for each in PGA_RANGES if each >= abs(through)) / CODES
    code = complex(round(through.real / step_i), round(through.imag / step_i))
    expected = round(0.607 / step_v) * step_v / (code * step_i) * 200.0
    assert found == pytest.approx(expected, rel=1e-12)
    assert 1e-7 < abs(found / Z - 1) < 3e-5
    assert status == 0
    Z, status = read_one(only(quantisation=True), 1e15)
    assert status == Status.LOW_CURRENT
    # One code of the smallest range, through RTIA.
    assert abs(Z) == pytest.approx(0.607 / (0.133 / 2**17 / 200.0), rel=1e-4)
    assert read_one(only(quantisation=True), 1e6)[1] == 0
    short, status = read_one(only(clipping=True), 0.0)
    assert np.isfinite(short)
    assert status == Status.CLIPPED
    phase = 2 * np.pi * np.arange(2**19) / 2**19
    for size in (0.5, 1.0, 1.001, 1.3, 2.0, 10.0, 1e4):
        wave = np.clip(size * np.cos(phase + 0.7), -1.0, 1.0)
        fundamental = 2 * np.mean(wave * np.exp(-1j * phase))
        found = clipped_fundamental(np.array([size * np.exp(0.7j)]), np.array([1.0]))[0]
        assert found == pytest.approx(fundamental, rel=1e-5)
    assert clipped_fundamental(np.array([1.0 + 0j]), np.array([1.0]))[0] == 1.0


@pytest.mark.parametrize(("rtia", "most"), [(200.0, 3e-3), (1000.0, 0.9e-3)])
def test_clipping_begins_where_the_current_passes_3_mA_or_what_rtia_makes_0_9_V(rtia, most):
    fixed = only(clipping=True, excitation=0.607, rtia=rtia)
    edge = 0.607 / most
    Z, status = read_one(fixed, edge * (1 + 1e-9))
    assert status == 0
    assert Z == pytest.approx(edge, rel=1e-8)
    assert read_one(fixed, edge * (1 - 1e-9))[1] == Status.CLIPPED
    Z, status = read_one(fixed, edge / 2)
    assert Z == pytest.approx(edge / 2 / (2 / np.pi * (np.pi / 6 + np.sqrt(3) / 4)), rel=1e-12)
    assert status == Status.CLIPPED


@pytest.mark.parametrize("pga", [0.6, 0.133])
def test_clipping_begins_where_the_voltage_passes_the_range(pga):
    terms = {"clipping": True, "rtia": 200.0, "excitation": 0.607}
    Z, status = read_one(only(**terms, pga_range=pga), 5000.0)
    r = pga / 0.607
    part = 2 / np.pi * (np.arcsin(r) + r * np.sqrt(1 - r * r))
    assert Z == pytest.approx(5000.0 * part, rel=1e-12)
    assert status == Status.CLIPPED
    assert read_one(only(**terms, pga_range=0.9), 5000.0)[1] == 0


@pytest.mark.parametrize(
    ("impedance", "excitation", "rtia"),
    [
        *((1e6, 0.607, 200.0), (202.34, 0.607, 200.0), (202.33, 0.121, 200.0)),
        *((40.34, 0.121, 200.0), (40.33, 0.075, 200.0), (25.01, 0.075, 200.0)),
        *((24.99, 0.015, 200.0), (5.01, 0.015, 200.0), (4.0, 0.015, 200.0)),
        *((674.5, 0.607, 1000.0), (674.4, 0.121, 1000.0)),  # 0.9 V through 1 kohm are 0.9 mA
    ],
)
def test_auto_ranging_takes_the_largest_excitation_that_fits(impedance, excitation, rtia):
    Z = np.array([[complex(impedance)]])
    assert np.abs(drive_current(Z, Z, rtia)) == pytest.approx(excitation / impedance, rel=1e-12)
    clips = impedance < 5.0
    status = read_one(only(clipping=True, rtia=rtia), impedance)[1]
    assert status == (Status.CLIPPED if clips else 0)
