"""Compiled kernels: equal to plain numpy, and right whatever happened to their files."""

import errno
import os

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eitskin import compiled
from eitskin.compiled import kernel, kernels
from eitskin.geometry import Bend, SensorDesign
from eitskin.geometry.deformation.kinematics import pulled_back_entries
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import Scene, Simulator, Touch

from on_demand import OnDemand, require_kernels

pytestmark = pytest.mark.slow

KERNELS = "eitskin.simulator.deformation.kernels"
require_kernels()
numba = OnDemand("numba")

COARSE = ((2, 2, 1), Grading(2e-3, 8e-3, 3.0))
PRESSED = (Touch(0.050, 0.020, 6.0), Touch(0.078, 0.034, 4.0), Touch(0.130, 0.045, 3.0))


def with_kernels(evaluated, *arguments):
    with kernels():
        return evaluated(*arguments)


@pytest.fixture(scope="module")
def sim():
    return Simulator(SensorDesign.reference(), COARSE)


@pytest.mark.parametrize("scene", [Scene(touches=PRESSED), Scene(Bend(35.0), PRESSED[:1])])
def test_deformations_are_those_of_plain_numpy(sim, scene) -> None:
    points = sim.model.assembly.points
    layer = sim.deformed_layer(scene)
    plain = layer.entries(points)
    assert with_kernels(layer.entries, points) == pytest.approx(plain, rel=1e-11, abs=1e-13)
    rng = np.random.default_rng(0)
    scattered = rng.uniform((0.0, 0.0, 0.0), (0.150, 0.060, 0.005), (500, 3))
    for evaluated in (layer.deformation.gradient, layer.deformation.positions):
        plain = evaluated(scattered)
        assert with_kernels(evaluated, scattered) == pytest.approx(plain, rel=1e-11, abs=1e-12)


def test_the_pull_back_is_that_of_plain_numpy_and_counts_what_is_inside_out():
    """A count sends the points to plain numpy: with that a wrong kernel would be slow alone."""
    rng = np.random.default_rng(1)
    F, shift = np.eye(3) + 0.2 * rng.standard_normal((2, 40, 3, 3))
    F[:2] = np.diag([-1.0, 1.0, 1.0])
    sigma, entries = rng.uniform(0.5, 2.0, 40), np.empty((40, 6))
    pull_back = compiled.load_kernels(KERNELS).pull_back
    assert pull_back(F.reshape(-1, 9), np.empty((0, 9)), sigma, entries) == 2
    assert entries[2:] == pytest.approx(sigma[2:, None] * pulled_back_entries(F[2:]), rel=1e-12)
    assert pull_back(F[2:].reshape(-1, 9), shift[2:].reshape(-1, 9), sigma[2:], entries[2:]) == 0
    expected = sigma[2:, None] * pulled_back_entries(F[2:] @ shift[2:])
    assert entries[2:] == pytest.approx(expected, rel=1e-12)


def test_frames_and_scenes_in_single_precision_are_those_of_plain_numpy(sim, monkeypatch):
    scenes = [Scene(Bend(20.0), PRESSED), Scene(touches=PRESSED[:1]), Scene(Bend(-10.0))]
    plain = np.array([sim.measure(scene).impedance for scene in scenes])
    found = sim.measure_all(scenes, tolerance=0.0)
    flat = sim.measure(Scene()).impedance
    assert not np.array_equal(found, plain)  # kernels round otherwise
    assert np.abs(found - plain).max() < 1e-8 * np.abs(plain - flat).max()
    sim = Simulator(SensorDesign.reference(), "coarse")
    found = sim.impedances(scenes, 1e-5)
    monkeypatch.setattr(compiled, "load_kernels", lambda _: None)
    plain = sim.impedances(scenes, 1e-5)
    assert not np.array_equal(found, plain)
    assert np.abs(found - plain).max() < 1e-6 * np.abs(plain).max()


def test_kernels_can_be_left_out(monkeypatch) -> None:
    assert compiled.compiled_kernels(KERNELS) is None
    assert with_kernels(compiled.compiled_kernels, KERNELS) is not None
    monkeypatch.setenv("EITSKIN_PLAIN", "1")
    assert compiled.load_kernels.__wrapped__(KERNELS) is None


# Files


def sum_of_squares(x):
    total = 0.0
    for each in x:
        total += each * each
    return total


def from_disk():
    """Whether the code of the kernel, made anew and right, came from the disk."""
    made = kernel("float64(float64[::1])")(sum_of_squares)
    assert made(np.arange(4.0)) == 14.0
    return sum(made.stats.cache_hits.values()) == 1


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Index and code of the kernel, with their contents."""
    folder = tmp_path_factory.mktemp("kernels")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(numba.config, "CACHE_DIR", str(folder))
        assert not from_disk()
        assert from_disk()
        files = [path for path in folder.rglob("*") if path.is_file()]
        assert len(files) == 2
        yield {path: path.read_bytes() for path in files}


@settings(max_examples=10)
@given(st.data())
def test_a_file_cut_or_changed_anywhere_is_made_again(files, data):
    path = data.draw(st.sampled_from(sorted(files)))
    whole = files[path]
    place = data.draw(st.integers(0, len(whole) - 1))
    changed = whole[:place] + bytes([whole[place] ^ 1 << place % 8]) + whole[place + 1 :]
    path.write_bytes(data.draw(st.sampled_from([whole[:place], changed])))
    assert not from_disk()
    assert from_disk()


def test_a_full_disk_costs_no_more_than_another_compilation(monkeypatch, tmp_path):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(os, "replace", full)
    assert not from_disk()
    assert not from_disk()
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
