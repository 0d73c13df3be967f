"""`eitskin bench layouts`: bounds over the sheet, and where mirrors spare the solving."""

from dataclasses import replace

import numpy as np
import pytest
from layouts_fakes import FEW, FEWEST, flat_bound, moved

from eitskin.benchmarks.layouts import bound as layouts_bound
from eitskin.benchmarks.layouts.bound import own_mirrors, sheet_bound, touch_derivatives
from eitskin.benchmarks.layouts.candidates import paper, sweeps, with_electrodes
from eitskin.geometry import Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.simulator import Instrument, Scene, Simulator, Touch
from eitskin.training.evaluation.cramer_rao import scene_derivatives

PLACES = np.array([[0.045, 0.020], [0.110, 0.035]])


@pytest.fixture(scope="module")
def sim():
    return Simulator(SensorDesign.reference(), "fast")


@pytest.fixture(scope="module")
def untouched(sim):
    return scene_derivatives(sim, Scene())


@pytest.fixture(scope="module")
def derivatives(sim, untouched):
    return touch_derivatives(sim, untouched, 0.0, PLACES)


@pytest.fixture(scope="module")
def few():
    return sheet_bound(paper(), FEW)


@pytest.mark.slow
def test_derivatives_agree_with_a_difference_of_fourth_order_of_whole_solutions(sim, derivatives):
    rows = {"x": (0, 0, 1.5e-3), "y": (1, 1, 1.5e-3), "force": (0, 2, 0.3)}
    for name, (place, row, h) in rows.items():
        touch = Touch(*PLACES[place].tolist(), 10.0)
        logs = [
            np.log(sim.measure(Scene(touches=(replace(touch, **{name: v}),))).impedance.real)
            for v in getattr(touch, name) + h * np.array([-2, -1, 1, 2])
        ]
        slope = (logs[0] - 8 * logs[1] + 8 * logs[2] - logs[3]) / (12 * h)
        error = np.abs(derivatives[place].by_touch[0, row] - slope).max() / np.abs(slope).max()
        assert error < 0.05, name  # `fast` leaves 1 % of signals and more of their slopes


@pytest.mark.slow
def test_a_layout_is_judged_as_each_scene_is(few, sim):
    scene = Scene(touches=(Touch(few.x[1], few.y[1], 10.0),))
    found = scene_derivatives(sim, scene)
    least = found.bound(found.noise(Instrument(), sim.full_scale))
    assert few.place[1, 1] == pytest.approx(least.place[0], rel=0.02)
    assert few.force[1, 1] == pytest.approx(least.force[0], rel=0.02)
    assert few.angle_deg[1, 1] == pytest.approx(least.angle_deg, rel=0.03)


@pytest.mark.slow
def test_bounds_fall_with_the_root_of_signal_to_noise():
    """20 dB are a hundredth of the noise's power."""
    worse, better = (sheet_bound(paper(), replace(FEWEST, snr_db=snr)) for snr in (65.0, 85.0))
    for name in ("place", "place_known", "force", "angle_deg", "untouched_deg"):
        np.testing.assert_allclose(getattr(worse, name), 10.0 * getattr(better, name), rtol=1e-6)
    np.testing.assert_allclose(better.spectrum, 10.0 * worse.spectrum, rtol=1e-9)


@pytest.mark.slow
def test_more_measurements_never_raise_a_bound(derivatives):
    order = np.random.default_rng(3).permutation(28)
    for found in derivatives:
        bounds = []
        for count in (6, 9, 14, 20, 28):
            part = order[:count]
            kept = replace(
                found,
                resistance=found.resistance[part],
                by_touch=found.by_touch[..., part],
                by_angle=found.by_angle[part],
            )
            least = kept.bound(kept.noise(Instrument(), 800.0))
            bounds.append((least.place[0], least.force[0], least.angle_deg))
        assert np.all(np.diff(bounds, axis=0) <= 0.0)
        assert bounds[-1][0] < 0.9 * bounds[0][0]


@pytest.mark.slow
def test_the_sheet_mirrors_itself_where_the_layout_does(few, monkeypatch):
    """Without being told so: every place is solved by itself."""
    monkeypatch.setattr(layouts_bound, "_MIRRORS", ((False, False),))
    whole = sheet_bound(paper(), FEW)
    for values in (whole.place, whole.force, whole.signal):
        np.testing.assert_allclose(values, values[::-1], rtol=2e-3)
        np.testing.assert_allclose(values, values[:, ::-1], rtol=2e-3)
    assert whole.place.max() > 1.1 * whole.place.min()
    np.testing.assert_allclose(few.place, whole.place, rtol=2e-3)
    np.testing.assert_allclose(few.spectrum, whole.spectrum, rtol=1e-3)


@pytest.mark.slow
def test_a_layout_with_one_mirror_is_solved_in_half_of_the_sheet(monkeypatch):
    electrodes = [
        replace(each, y=0.020) if each.y == 0.030 else each
        for each in SensorDesign.reference().electrodes
    ]
    layout = with_electrodes("lower at both ends", electrodes)
    half = sheet_bound(layout, FEWEST)
    monkeypatch.setattr(layouts_bound, "_MIRRORS", ((False, False),))
    whole = sheet_bound(layout, FEWEST)
    np.testing.assert_allclose(half.place, whole.place, rtol=2e-3)
    np.testing.assert_allclose(half.spectrum, whole.spectrum, rtol=1e-3)
    assert half.place[0, 0] != pytest.approx(half.place[1, 0], rel=0.1)


def test_mirrors_of_layouts():
    outline = Rectangle(0.150, 0.060)
    turned = with_electrodes("half a pitch on", uniform(outline, 8))
    mirrors = [[mirror for mirror, _ in own_mirrors(each.design)] for each in (turned, moved())]
    assert mirrors == [[(False, False), (True, True)], [(False, False)]]
    assert [len(list(own_mirrors(layout.design))) for layout in sweeps()["count"]] == [4] * 6


@pytest.mark.slow
def test_measurements_are_renumbered_in_the_mirror(sim):
    for (along, across), order in own_mirrors(sim.design):
        x, y = 0.040, 0.022
        image = (0.150 - x if along else x, 0.060 - y if across else y)
        here, there = (
            sim.measure(Scene(touches=(Touch(*place, 10.0),))).impedance.real
            for place in ((x, y), image)
        )
        np.testing.assert_allclose(there[order], here, rtol=1e-6)


def test_what_is_said_of_signals():
    bound = flat_bound(1.0, signal=np.linspace(10.0, 20.0, 11))
    assert bound.uniformity == pytest.approx(11.0 / 19.0)
    assert bound.condition == pytest.approx(8.0)
    many = flat_bound(1.0, spectrum=1.0 / np.arange(1.0, 29.0))
    assert many.condition == pytest.approx(15.0)
    assert bound.patterns == 2


@pytest.mark.slow
def test_pads_keep_their_digits():
    """A pad's own resistance is much of what is measured; 2 % of force changes little."""
    design = sweeps()["placement"][2].design
    sim = Simulator(design, layouts_bound.judged_discretisation(design, "fast"))
    scenes = [Scene(touches=(Touch(0.0975, 0.0225, force),)) for force in (9.8, 10.0)]
    flat, less, more = np.log(sim.measure_all([Scene(), *scenes]).real)
    signal = np.abs(more - flat).max()
    assert signal > 0.01
    assert np.abs(more - less).max() < 0.03 * signal
