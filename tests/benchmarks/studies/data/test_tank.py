"""The water tank: fits of a tank that is known, by an integral equation, and of the real one."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from eitskin.benchmarks.studies.data import tank as report
from eitskin.benchmarks.studies.data.tank_data import Tank, read_tank
from eitskin.benchmarks.studies.data.tank_fit import FIRST, fit, residuals, slopes, start
from eitskin.errors import DataError
from eitskin.geometry.meshing.grading import Grading

import closed_forms

DATA = Path(os.environ.get("EITSKIN_DATA", Path(__file__).parents[5] / "shared" / "data"))
QUICK = ((3,), Grading(finest=1e-3, coarsest=6e-2, growth=1.5))
COUNT, RADIUS, WIDTH = 6, 0.115, 0.5
SHEET, CONTACT = 1.7, 2e-3


def pairs(step):
    """Columns that go from each electrode to the one `step` further, but for the last one."""
    return np.eye(COUNT)[:, :-1] - np.roll(np.eye(COUNT), step, axis=0)[:, :-1]


def voltages(tank, angles, width, contact=CONTACT, sheet=SHEET):
    """The voltages of the tank with these electrodes, by the integral equation."""
    Z = sheet * closed_forms.disc_impedance(angles, width, contact / RADIUS, points=24)
    return tank.senses.T @ Z @ tank.currents


@pytest.fixture(scope="module")
def tank() -> Tank:
    angles = 0.4 + 2 * np.pi / COUNT * np.arange(COUNT)
    currents = np.hstack([pairs(2), 1.5 * pairs(3)])
    empty = np.zeros((COUNT - 1, currents.shape[1]))
    blank = Tank(RADIUS, angles, WIDTH, currents, pairs(1), empty)
    return dataclasses.replace(blank, voltages=voltages(blank, angles, WIDTH))


@pytest.fixture(scope="module")
def derivatives(tank):
    return slopes(tank, resolution=QUICK)


def test_protocol_measures_what_the_patterns_say(tank) -> None:
    Z = np.random.default_rng(0).standard_normal((COUNT, COUNT))
    measured = tank.amplitudes * tank.protocol.measure(Z)
    assert measured.reshape(tank.voltages.shape[::-1]).T == pytest.approx(
        tank.senses.T @ Z @ tank.currents
    )
    assert tank.driven[0].tolist() == (np.abs(tank.currents[:2]).sum(axis=0) > 0).tolist()


@pytest.mark.slow
def test_conductivity_and_contact_impedance_are_found(tank, derivatives) -> None:
    found = fit(tank, FIRST, start(tank), derivatives, QUICK)
    assert found.values["sheet"] == pytest.approx([SHEET], rel=1e-3)
    assert found.values["contact"] == pytest.approx([CONTACT], rel=0.02)
    assert max(found.residual) < 1e-3
    assert found.unknowns == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "key", "close"),
    [
        ("a contact impedance per electrode", "contacts", 2e-4),
        ("a place per electrode", "place", 1e-3),
        ("one electrode width", "width", 3e-3),
        ("a constant per channel", "constant", 2e-3),
    ],
)
def test_what_differs_is_found(tank, derivatives, name, key, close) -> None:
    """A tank with one kind of irregularity is explained by freeing that kind, and not without."""
    rng = np.random.default_rng(2)
    true = {**start(tank), "contact": np.array([CONTACT])}
    spread = {"contacts": 4e-3 * rng.random(COUNT), "place": 0.02 * rng.uniform(-1, 1, COUNT)}
    spread |= {"width": [1.15], "constant": 0.1 * rng.uniform(-1, 1, COUNT - 1)}
    begin = true | {"sheet": np.array([SHEET])}
    true[key] = np.array(spread[key])
    if key == "place":
        true[key] -= true[key].mean()  # turning them all changes nothing
    contacts = true["contact"] + true["contacts"]
    measured = voltages(tank, tank.angles + true["place"], WIDTH * true["width"][0], contacts)
    odd = dataclasses.replace(tank, voltages=measured + true["constant"][:, None])
    found = fit(odd, name, begin, derivatives, QUICK)
    assert found.values[key] - found.values[key].mean() * (key == "place") == pytest.approx(
        true[key], abs=close
    )
    assert found.residual[0] < 1e-3
    if key != "width":  # wider electrodes look much like better water
        assert fit(odd, FIRST, begin, derivatives, QUICK).residual[0] > 5e-3


def write(folder, tank, **changes):
    """The challenge's two files: rim points in turn, three to an electrode."""
    turns = np.array([-0.5, 0.0, 0.5]) * tank.width
    angles = (tank.angles[:, None] + turns).ravel()
    faces = np.empty((1, COUNT), dtype=object)
    for e in range(COUNT):
        faces[0, e] = np.array([[3 * e, 3 * e + 1], [3 * e + 1, 3 * e + 2]], dtype=np.uint8)
    places = tank.radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    reference = {
        "Injref": tank.currents,
        "Mpat": tank.senses.astype(np.int16),
        "Uelref": tank.voltages.T.reshape(-1, 1),
    }
    savemat(folder / "ktc2023_ref.mat", reference | changes)
    savemat(folder / "ktc2023_mesh_sparse.mat", {"g": places, "elfaces": faces} | changes)


def test_files_are_read(tank, tmp_path) -> None:
    write(tmp_path, tank)
    read = read_tank(tmp_path)
    assert read.radius == pytest.approx(tank.radius)
    assert read.angles == pytest.approx(tank.angles)
    assert read.width == pytest.approx(tank.width)
    assert read.voltages == pytest.approx(tank.voltages)
    assert read.protocol == tank.protocol


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"Injref": np.ones((COUNT, 10))}, "one positive and one negative"),
        ({"Uelref": np.ones(5)}, "expected 10 patterns x 5 channels of voltages, got 5"),
        ({"g": np.random.default_rng(0).random((3 * COUNT, 2))}, "at equal distances"),
    ],
)
def test_files_that_do_not_fit_are_refused(tank, tmp_path, changes, message) -> None:
    write(tmp_path, tank, **changes)
    with pytest.raises(DataError, match=message):
        read_tank(tmp_path)


def test_missing_files_are_named(tank, tmp_path) -> None:
    with pytest.raises(DataError, match=r"ktc2023_ref\.mat"):
        read_tank(tmp_path)
    write(tmp_path, tank)
    savemat(tmp_path / "ktc2023_mesh_sparse.mat", {"g": np.zeros((3, 2))})
    with pytest.raises(DataError, match="elfaces missing"):
        read_tank(tmp_path)


@pytest.mark.slow
def test_the_real_tank() -> None:
    """With ideal places 8.9 % is left as z -> 0: by the model here and by the integral equation."""
    if not (DATA / "ktc2023_ref.mat").is_file():
        pytest.skip(f"no tank in {DATA}; set EITSKIN_DATA to the folder of real recordings")
    tank = read_tank(DATA)
    assert tank.voltages.size == 2356
    Z = closed_forms.disc_impedance(tank.angles, tank.width, 1e-7 / tank.radius, points=6)
    plain = tank.senses.T @ Z @ tank.currents
    exact = residuals(tank, plain * (plain * tank.voltages).sum() / (plain**2).sum())
    assert exact == pytest.approx((0.0893, 0.0573, 0.1759), abs=1e-4)
    begin = {**start(tank), "contact": np.full(1, 1e-7)}
    frozen = {"place": np.zeros((2356, 32)), "width": np.zeros((2356, 1))}
    found = fit(tank, FIRST, begin, frozen, report.COARSER[-1])
    assert found.residual == pytest.approx(exact, rel=0.04)
    assert f"{100 * found.residual[0]:.2f}" in report.row(found)
