"""Presses that teach maps of channels, and places found by those."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest
from touched_dataset import touched_dataset
from toy_skin import toy_presses

from eitskin.cli.commands import train
from eitskin.datasets import RecordingNames, State, read_recording, save_dataset
from eitskin.errors import DataError, UnusableFrameError
from eitskin.geometry import Disc, Electrode, SensorDesign
from eitskin.simulator import Frame, Protocol
from eitskin.training import Pipeline, PositionScore, TrainingSettings, open_pipeline
from eitskin.training.adaptation import sheet
from eitskin.training.adaptation.channel_maps import (
    DROPPED_VARIANCE_SHARE,
    ChannelMaps,
    KernelFeatures,
    PlaceKernel,
    Presses,
)
from eitskin.training.adaptation.locator import (
    MapGrid,
    PressLocator,
)
from eitskin.training.adaptation.press_fit import LabelledPresses, learn_places
from eitskin.training.adaptation.sheet import Sectors, design_span

pytestmark = pytest.mark.slow

DATA = Path(os.environ.get("EITSKIN_DATA", Path(__file__).parents[4] / "shared" / "data"))

POSITIONS = TrainingSettings("touch position")


@pytest.fixture(scope="module")
def learned():
    ratio, places, depth = toy_presses()
    return learn_places(LabelledPresses(ratio, places, depth))


def test_places_strength_and_errors_are_learned_also_without_depths_or_channels(learned):
    ratio, places, depth = toy_presses(30, seed=1)
    found, left_out = learned.locator.locate(ratio)
    error = np.linalg.norm(found.place - places, axis=1)
    assert np.median(error) < 1e-3
    assert 0.35 < np.sqrt(np.mean((error / found.deviation) ** 2)) < 1.5
    assert not left_out.any()
    assert abs(learned.law.exponent - 1.5) < 0.1
    inner = np.abs(places).max(axis=1) < 0.04
    np.testing.assert_allclose(
        found.strength[inner], learned.law.strength(depth[inner]), rtol=0.045
    )
    ratio, places, _ = toy_presses()
    other, where, _ = toy_presses(60, seed=1)
    blind = learn_places(LabelledPresses(ratio, places))
    assert blind.law is None
    error = np.linalg.norm(blind.locator.apply(other) - where, axis=1)
    assert np.median(error) < 1.5e-3
    ratio, places, depth = toy_presses()
    ratio[len(ratio) // 2 :, 0] = np.nan
    validated = learn_places(LabelledPresses(ratio, places, depth)).validated
    assert validated["presses"] == len(places)
    assert validated["mean_error_mm"] < 3
    ratio, places, _ = toy_presses()
    with pytest.raises(DataError, match="at least 5"):
        learn_places(LabelledPresses(ratio[:4], places[:4]))
    with pytest.raises(DataError, match="different positions"):
        learn_places(LabelledPresses(ratio, np.zeros_like(places)))
    with pytest.raises(DataError, match="8 channels, got 7"):
        learned.locator.apply(ratio[:, :7])


def test_few_presses_are_explained_in_several_ways():
    """Places are means over them, in whatever units each has its channels, and saved with them."""
    ratio, places, depth = toy_presses(6)
    few = learn_places(LabelledPresses(ratio, places, depth)).locator
    assert len(few.others) == 3  # lengths and noises, without a design
    other = toy_presses(20, seed=5)[0]
    answers = np.log(other) / few.gain
    alone = [grid.locate(answers).place for grid in (few.grid, *few.others)]
    drawn = few.grid.middle + few.trust * (np.mean(alone, axis=0) - few.grid.middle)
    np.testing.assert_allclose(few.apply(other), drawn, atol=1e-12)
    units = np.linspace(0.5, 2.0, 8)
    scaled = dataclasses.replace(few.grid, whitening=units[:, None] * few.grid.whitening)
    same = scaled.locate(answers / units)
    np.testing.assert_allclose(same.place, alone[0], atol=1e-9)
    restored = PressLocator.from_arrays(few.arrays())
    np.testing.assert_array_equal(restored.apply(other), few.apply(other))
    assert learn_places(LabelledPresses(*toy_presses(9))).locator.others == ()


def test_noisy_places_are_drawn_to_the_middle_as_suits_presses_not_seen():
    corner = np.array([0.3, 0.2])  # the middle is not at the origin
    ratio, places, _ = toy_presses(noise=0.02)
    locator = learn_places(LabelledPresses(ratio, places + corner)).locator
    other, where, _ = toy_presses(400, seed=10, noise=0.02)
    middle = locator.grid.middle
    away = dataclasses.replace(locator, trust=1.0).apply(other) - middle
    best = np.vdot(away, where + corner - middle) / np.vdot(away, away)  # 0.58
    assert abs(locator.trust - best) < 0.2  # 0.68: left-out presses show a little more


def test_measured_hydrogel_skin():
    """500 presses of a real skin: places of the last 100 from the first 400, without a design."""
    if not (DATA / "ohmc8.mat").is_file():
        pytest.skip(f"no ohmc8.mat in {DATA}; set EITSKIN_DATA to the folder that holds it")
    names = RecordingNames("responsedowns", "responseups", "positions")
    recording = read_recording(DATA / "ohmc8.mat", names)
    score = PositionScore.from_dataset(Pipeline.fit(recording, POSITIONS), recording)
    assert score.frames == 100
    assert score.mean_error_mm < 2.5
    assert score.guess_error_mm > 40.0


# ---- locator ----


def test_a_grid_without_channels_is_that_of_maps_that_never_had_them():
    rng = np.random.default_rng(0)
    maps = rng.standard_normal((12, 10, 6))
    whitening = np.diag(rng.uniform(0.5, 2.0, 6))  # independent noise
    spread, prior = 0.01 * np.ones_like(maps), np.zeros(maps.shape[:2])
    keep = np.array([True, False, True, True, False, True])
    grid = MapGrid(np.zeros(2), 1e-3, maps, spread, prior, whitening, np.array([1.0, 0.2]))
    alone = dataclasses.replace(
        grid,
        mean=maps[..., keep],
        variance=spread[..., keep],
        whitening=whitening[np.ix_(keep, keep)],
    )
    answers = rng.standard_normal((4, 6))
    found = grid.locate(answers, np.tile(~keep, (4, 1)))
    wanted = alone.locate(answers[:, keep])
    np.testing.assert_allclose(found.place, wanted.place, atol=1e-7)
    np.testing.assert_allclose(found.deviation, wanted.deviation, rtol=1e-4)
    np.testing.assert_allclose(found.misfit[:, keep], wanted.misfit, atol=1e-3)


# Positions in a session: live, on a replay, saved and opened

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
def opened(folder):
    return open_pipeline(folder / "skin.eitmodel")


def frame(values, number, **changes):
    values = np.asarray(values, dtype=complex).reshape(-1)
    return Frame(values, PROTOCOL, 0.1 * number, number, **changes)


def test_a_press_has_a_position_alone_also_with_channels_that_are_lost(opened):
    assert opened.targets.missing == ("the state", "the bend angle", "forces")
    noise = 1.0 + 1e-4 * np.random.default_rng(1).standard_normal((5, 15))
    for number, values in enumerate(FLAT * noise):
        assert opened.process(frame(values, number)).touches == ()
    estimate = opened.process(frame(pressed(PRESS), 5))
    ((x, y, strength),) = estimate.touches
    assert np.hypot(x - PRESS[0], y - PRESS[1]) < 0.004
    assert 0.2 < strength <= 1.0
    unknown = (estimate.state, estimate.bend_angle_deg, estimate.touch_map)
    assert unknown == (None, None, None)
    assert np.isnan(estimate.probabilities).all()
    assert np.isnan(estimate.touches[0].force)
    assert opened.process(frame(FLAT, 6)).touches == ()
    opened.process(frame(FLAT, 0))
    values = pressed(PRESS)
    values[0, 3] = np.nan
    estimate = opened.process(frame(values, 1))
    assert "channel 0-4 is left out" in estimate.problems[0]
    assert np.hypot(estimate.touches[0][0] - PRESS[0], estimate.touches[0][1] - PRESS[1]) < 0.01
    with pytest.raises(UnusableFrameError):
        opened.process(frame(np.full(15, np.nan), 2))


# Maps of channels


KERNEL = PlaceKernel(0.03)


def presses(count=30, channels=4, seed=0):
    rng = np.random.default_rng(seed)
    places = rng.uniform(0.0, 0.1, (count, 2))
    waves = rng.uniform(-40.0, 40.0, (2, channels))
    strength = rng.uniform(0.5, 2.0, count)
    answers = strength[:, None] * np.cos(places @ waves)
    return Presses.from_frames(places, strength, answers + 0.1 * rng.standard_normal(answers.shape))


def dense(maps, learned, at):
    """Mean and covariance of all channels at places, by the full covariance of all answers."""
    back = np.linalg.inv(maps.whitening)
    signal, noise = back.T @ np.diag(maps.gain) @ back, back.T @ back
    s, n = learned.strength, len(learned.strength)
    full = np.kron(KERNEL(learned.places, learned.places) * np.outer(s, s), signal)
    full += np.kron(np.diag(1.0 / learned.weight), noise)
    cross = np.kron(KERNEL(at, learned.places) * s, signal)
    mean = cross @ np.linalg.solve(full, learned.answers.ravel())
    prior = np.kron(KERNEL(at, at), signal)
    covariance = prior - cross @ np.linalg.solve(full, cross.T)
    assert n * len(signal) == len(full)
    return mean.reshape(len(at), -1), covariance, back


def test_features_leave_out_no_more_than_they_may_and_no_place_is_in_vain():
    places = np.random.default_rng(2).uniform(0.0, 0.01, (300, 2))
    chosen = KernelFeatures.choose(KERNEL, places).chosen
    assert len(chosen) < 100

    def missing(some):
        """Share of the variance that features of some places leave out."""
        across = KERNEL(some, places)
        return 1.0 - np.mean(np.sum(across * np.linalg.solve(KERNEL(some, some), across), axis=0))

    assert missing(chosen) <= DROPPED_VARIANCE_SHARE < missing(chosen[:-1])


@pytest.mark.parametrize("weighted", [False, True])
def test_maps_are_those_of_the_full_covariance(weighted):
    learned = presses()
    if weighted:
        learned.weight[20:] = 0.1
    maps = ChannelMaps.fit(KERNEL, learned, 0.05)
    at = np.random.default_rng(1).uniform(0.0, 0.1, (3, 2))
    mean, variance = maps.evaluate(at)
    expected, covariance, back = dense(maps, learned, at)
    np.testing.assert_allclose(mean @ back, expected, atol=1e-5)
    for place in range(3):
        own = covariance[4 * place : 4 * place + 4, 4 * place : 4 * place + 4]
        np.testing.assert_allclose(back.T @ np.diag(variance[place]) @ back, own, atol=1e-5)


def test_left_out_presses_are_predicted_as_by_a_fit_without_them():
    learned = presses()
    learned = learned.select(np.r_[np.arange(30), np.arange(5)])  # copies go with their owner
    learned.weight[30:] = 0.2
    learned.places[30:] += 0.01
    maps = ChannelMaps.fit(KERNEL, learned, 0.05)
    mean, variance = maps.left_out(learned)
    for press in (2, 17):
        rest = learned.select(learned.owner != press)
        expected, covariance, back = dense(maps, rest, learned.places[press : press + 1])
        s = learned.strength[press]
        np.testing.assert_allclose(mean[press] @ back, s * expected[0], atol=1e-5)
        noise = back.T @ back
        predicted = back.T @ np.diag(variance[press]) @ back
        np.testing.assert_allclose(predicted, s**2 * covariance + noise, atol=1e-5)


# ---- sheet ----


RADIUS, N = 0.05, 6
ANGLES = 2 * np.pi * np.arange(N) / N
RING = Protocol.from_rows(
    [(d, (d + 3) % N, (s + 1) % N, s) for d in range(N) for s in ((d + 1) % N, (d + 4) % N)], N
)


def ring():
    x, y = RADIUS + 0.8 * RADIUS * np.array([np.cos(ANGLES), np.sin(ANGLES)])
    electrodes = tuple(
        Electrode(on="top", shape="round", width=0.004, x=float(a), y=float(b))
        for a, b in zip(x, y, strict=True)
    )
    return SensorDesign(Disc(RADIUS), 0.003, electrodes, encapsulated_thickness=0.003)


def answers(places, signs=1.0):
    """Ideal answers by the fields of point electrodes in an unbounded sheet."""
    z = (places - RADIUS) @ [1.0, 1j]
    field = 1.0 / (z[:, None] - 0.8 * RADIUS * np.exp(1j * ANGLES))
    rows = np.array(RING.table)
    drive = field[:, rows[:, 0]] - field[:, rows[:, 1]]
    sense = field[:, rows[:, 2]] - field[:, rows[:, 3]]
    return signs * np.real(drive * sense.conj()) * RADIUS**2


def test_rotations_gains_and_signs_of_a_ring_are_found_from_few_presses():
    sectors = Sectors.from_design(ring(), RING)
    assert sectors.turned.shape == (N, len(RING))
    places = RADIUS + np.random.default_rng(0).uniform(-0.02, 0.02, (5, 2))
    turned = np.empty((5, len(RING)))
    turned[:, sectors.turned[2]] = answers(places)
    np.testing.assert_allclose(turned, answers(sectors.rotate(places, 2)), atol=1e-12)
    fewer = Protocol(RING.table[1:], N)
    assert Sectors.from_design(ring(), fewer) is None
    assert Sectors.from_design(None, RING) is None
    assert Sectors.from_design(ring(), Protocol.pairwise(N)).turned.shape == (N, 15)
    half_turn = Sectors.from_design(SensorDesign.reference(), Protocol.adjacent(8))
    assert half_turn.turned.shape == (2, 40)
    square = dataclasses.replace(ring(), electrodes=ring().electrodes[:5])
    assert Sectors.from_design(square, Protocol.adjacent(5)) is None
    rng = np.random.default_rng(1)
    places = RADIUS + rng.uniform(-0.025, 0.025, (12, 2))
    signs = np.where(rng.random(len(RING)) < 0.5, -1.0, 1.0)
    sizes = np.exp(0.2 * rng.standard_normal(len(RING)))
    seen = answers(places, signs * sizes)
    gains = sectors.gains(PlaceKernel(0.04), Presses.from_frames(places, np.ones(12), seen))
    for orbit in sectors.turned.T:
        relative = gains[orbit] / (signs * sizes)[orbit]
        assert len(set(np.sign(relative))) == 1
        assert np.std(np.log(np.abs(relative))) < 0.25
    places = RADIUS + np.array([[0.01, 0.0], [0.0, 0.02]])
    presses = sectors.copy_to_sectors(Presses.from_frames(places, np.ones(2), answers(places)), 0.1)
    assert len(presses.strength) == 2 * N
    np.testing.assert_array_equal(presses.owner, np.tile([0, 1], N))
    np.testing.assert_array_equal(presses.weight, np.repeat([1.0, 0.1], [2, 2 * (N - 1)]))
    np.testing.assert_allclose(presses.answers, answers(presses.places), atol=1e-12)


def test_span_of_a_design_holds_the_maps_of_its_protocol(monkeypatch):
    """Any sensitivity is a combination of the span's maps: here against those of point sources."""
    monkeypatch.setattr(sheet, "SPAN_PIXELS", 900)
    span = design_span(ring())
    places = RADIUS + np.random.default_rng(2).uniform(-0.022, 0.022, (200, 2))
    features, wanted = span.features(places), answers(places)
    found = features @ np.linalg.lstsq(features, wanted, rcond=1e-6)[0]
    assert np.linalg.norm(found - wanted) < 0.03 * np.linalg.norm(wanted)
