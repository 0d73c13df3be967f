"""Learned touch positions in a session: live, on a replay, saved and opened."""

import numpy as np
import pytest
from touched_dataset import touched_dataset

from eitskin.cli.commands import train
from eitskin.datasets import State, save_dataset
from eitskin.errors import FrameError, UnusableFrameError
from eitskin.simulator import Frame, Protocol
from eitskin.training import open_pipeline

PROTOCOL = Protocol.pairwise(6)
OWN = 0.05 * np.stack([np.cos(np.arange(15)), np.sin(np.arange(15))], axis=1)
FLAT = np.linspace(100.0, 300.0, 15)
PRESS = (0.021, -0.012)


def pressed(places, strength=1.0):
    """Values of a toy skin, each channel sensitive near its own position."""
    distance = np.linalg.norm(np.atleast_2d(places)[:, None] - OWN, axis=2)
    return FLAT * (1.0 + 0.05 * strength * np.exp(-((distance / 0.03) ** 2)))


def recording():
    """Presses alone: no untouched frame, no bend, no force."""
    places = np.random.default_rng(0).uniform(-0.04, 0.04, (60, 2))
    labels = {"state": np.full(60, State.TOUCH), "time": np.arange(60.0), "episode": np.zeros(60)}
    return touched_dataset(pressed(places), FLAT, places, protocol=PROTOCOL, **labels)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("presses")
    save_dataset(recording(), made / "data")
    train.command(made / "data", out=made / "skin.eitmodel", quiet=True)
    return made


@pytest.fixture
def learned(folder):
    return open_pipeline(folder / "skin.eitmodel")


def frame(values, number, **changes):
    values = np.asarray(values, dtype=complex).reshape(-1)
    return Frame(values, PROTOCOL, 0.1 * number, number, **changes)


@pytest.mark.slow
def test_a_press_has_a_position_and_nothing_else(learned):
    assert learned.targets.missing == ("the state", "the bend angle", "forces")
    noise = 1.0 + 1e-4 * np.random.default_rng(1).standard_normal((5, 15))
    for number, values in enumerate(FLAT * noise):
        assert learned.process(frame(values, number)).touches == ()
    estimate = learned.process(frame(pressed(PRESS), 5))
    ((x, y, strength),) = estimate.touches
    assert np.hypot(x - PRESS[0], y - PRESS[1]) < 0.004
    assert 0.2 < strength <= 1.0
    unknown = (estimate.state, estimate.bend_angle_deg, estimate.touch_map)
    assert unknown == (None, None, None)
    assert np.isnan(estimate.probabilities).all()
    assert np.isnan(estimate.touches[0].force)
    assert learned.process(frame(FLAT, 6)).touches == ()


@pytest.mark.slow
def test_bad_channels_are_left_out_and_other_frames_refused(learned):
    learned.process(frame(FLAT, 0))
    values = pressed(PRESS)
    values[0, 3] = np.nan
    estimate = learned.process(frame(values, 1))
    assert "channel 0-4 is left out" in estimate.problems[0]
    assert np.hypot(estimate.touches[0][0] - PRESS[0], estimate.touches[0][1] - PRESS[1]) < 0.01
    with pytest.raises(UnusableFrameError):
        learned.process(frame(np.full(15, np.nan), 2))
    with pytest.raises(FrameError, match="15 measurements"):
        learned.process(Frame(np.ones(28), Protocol.pairwise(8)))
    table = Protocol((PROTOCOL.table[1], PROTOCOL.table[0], *PROTOCOL.table[2:]), 6)
    with pytest.raises(FrameError, match="trained for"):
        learned.process(Frame(FLAT, table))
    with pytest.raises(FrameError, match="40000 Hz"):
        learned.process(frame(FLAT, 3, frequency=1e3))
