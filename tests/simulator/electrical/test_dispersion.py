"""Conductivities by the frequency, against closed forms, published values and other elements."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import skfem
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu
from skfem.helpers import dot, grad

from eitskin.datasets import Recipe
from eitskin.datasets.generation.shard_simulation import simulate_frames
from eitskin.geometry import (
    Bend,
    ColeCole,
    ConductivityTable,
    Electrode,
    Inclusion,
    Layer,
    Rectangle,
    SensorDesign,
)
from eitskin.simulator import ForwardModel, Protocol, Scene, Simulator, Touch

# Muscle of Gabriel, Lau and Gabriel (1996).
MUSCLE = ColeCole(
    0.2,
    (50.0, 7000.0, 1.2e6, 2.5e7),
    (7.23e-12, 353.68e-9, 318.31e-6, 2.274e-3),
    (0.1,) * 3 + (0,),
    4,
)
FREQUENCIES = (1e3, 40e3, 1e6)
OUTLINE = Rectangle(0.04, 0.02)
PLACES = ((0.01, 0.0), (0.04, 0.01), (0.03, 0.02), (0.0, 0.01))
SMALL = SensorDesign(OUTLINE, 0.004, tuple(Electrode(*at, 0.01) for at in PLACES), MUSCLE)


def test_muscle_has_its_published_values_and_a_bar_the_spectrum_of_its_conductivity():
    """L / (sigma A) + 2 z / A; two sheets, of which one has a table, are side by side."""
    for frequency, sigma, permittivity in ((1e4, 0.34083, 25909), (1e5, 0.36185, 8089.2)):
        value = MUSCLE.evaluate(frequency)
        assert value.real == pytest.approx(sigma, rel=1e-4)
        permittivity_found = value.imag / (2 * np.pi * frequency * 8.8541878e-12)
        assert permittivity_found == pytest.approx(permittivity, rel=1e-4)
    table = ConductivityTable((1e3, 1e6), (0.4, 0.6 + 0.2j))
    ends = (Electrode(0.0, 0.02, 0.04), Electrode(0.1, 0.02, 0.04))
    design = SensorDesign(Rectangle(0.1, 0.04), 0.005, ends, MUSCLE)
    layers = (Layer(0.002, MUSCLE), Layer(0.003, table))
    sheets = dataclasses.replace(design, conductivity=1.0, layers=layers)
    area, pair = 0.04 * 0.005, Protocol.pairwise(2)
    for sensor in (design, sheets):
        Z = ForwardModel(sensor, "coarse").impedance(contact_impedance=1e-9, frequency=FREQUENCIES)
        for frequency, matrix in zip(FREQUENCIES, Z, strict=True):
            sigma = MUSCLE.evaluate(frequency)
            if sensor is sheets:
                sigma = 0.4 * sigma + 0.6 * table.evaluate(frequency)
            assert pair.measure(matrix)[0] == pytest.approx(0.1 / sigma / area, rel=1e-5)


def test_all_ways_to_frames_are_linear_in_the_conductivity(tmp_path: Path) -> None:
    """Z(sigma c, z / c) = Z(sigma, z) / c for files, scenes, spectra and datasets."""
    scene = Scene(Bend(20.0), (Touch(0.05, 0.03),))
    contacts = tuple(
        dataclasses.replace(each, contact_impedance=1e-9)
        for each in SensorDesign.reference().electrodes
    )
    real = dataclasses.replace(SensorDesign.reference(), electrodes=contacts)
    expected = Simulator(real, "coarse").measure(scene).impedance
    file = tmp_path / "sensor.toml"
    dataclasses.replace(real, conductivity=MUSCLE).to_toml(file)
    simulator = Simulator(SensorDesign.from_toml(file), "coarse")
    spectrum = simulator.spectrum(scene, FREQUENCIES)
    for frequency, values in zip(FREQUENCIES, spectrum, strict=True):
        assert values * MUSCLE.evaluate(frequency) == pytest.approx(expected, rel=1e-6)
    assert simulator.measure(scene, frequency=1e6).frequency == 1e6
    assert simulator.measure_all([scene])[0] == pytest.approx(spectrum[1], rel=1e-12)
    mixed = dataclasses.replace(real, conductivity=0.5 + 0.2j)
    mixed_values = Simulator(mixed, "coarse").measure(scene).impedance
    assert mixed_values * (0.5 + 0.2j) == pytest.approx(expected, rel=1e-6)
    text = f'name = "one"\nresolution = "coarse"\nfrequency = 1e6\nsensor = "{file}"\n'
    text += 'instrument = { snr_db = 0.0 }\n[[scenes]]\nstate = "idle"\ncount = 1\n'
    (tmp_path / "recipe.toml").write_text(text)
    data = simulate_frames(Recipe.from_toml(tmp_path / "recipe.toml"), [0])
    flat = simulator.measure(Scene(), frequency=1e6).impedance
    assert data.frequency == 1e6
    assert np.asarray(data.impedance[0]) == pytest.approx(flat, rel=1e-6)


def impedances_by_boxes(sigma: tuple[complex, complex], part: np.ndarray) -> np.ndarray:
    """Impedances by triquadratic boxes of scikit-fem with complete electrodes on their faces.

    `sigma` outside and inside the box `part`, (2, 3) [m], whose faces are faces of the mesh.
    """
    lines = (np.linspace(0.0, size, n) for size, n in ((0.04, 17), (0.02, 9), (0.004, 5)))
    mesh, element = skfem.MeshHex.init_tensor(*lines), skfem.ElementHex2()
    basis = skfem.Basis(mesh, element)
    x = np.moveaxis(np.asarray(basis.global_coordinates()), 0, -1)
    inside = ((part[0] < x) & (x < part[1])).all(axis=-1)
    laplace = skfem.BilinearForm(lambda u, v, w: w.s * dot(grad(u), grad(v)), dtype=np.complex128)
    A = laplace.assemble(basis, s=np.where(inside, sigma[1], sigma[0]))
    columns, areas = [], []
    for electrode in SMALL.electrodes:
        axis = 0 if electrode.x in (0.0, 0.04) else 1  # of the side's normal
        centre = np.array([electrode.x, electrode.y])[:, None]
        room = np.where(np.arange(2) == axis, 1e-9, 0.005)[:, None]
        facets = mesh.facets_satisfying(
            lambda q, c=centre, r=room: (np.abs(q[:2] - c) < r).all(axis=0), boundaries_only=True
        )
        side = skfem.FacetBasis(mesh, element, facets=facets)
        load = skfem.LinearForm(lambda v, _: v).assemble(side) / electrode.contact_impedance
        mass = skfem.BilinearForm(lambda u, v, _: u * v).assemble(side)
        A = A + mass / electrode.contact_impedance
        columns.append(load)
        areas.append(load.sum())
    B = np.array(columns).T
    per_potential = splu(csc_array(A)).solve(B.astype(np.complex128))
    # A common potential drives no current, and is left out of the inverse.
    return np.linalg.pinv(np.diag(areas) - B.T @ per_potential, rcond=1e-9)


@pytest.mark.slow
def test_a_box_within_the_layer_changes_what_other_elements_say() -> None:
    """1 % of the change by a box from 1 to 3 mm, complex, and at two contrasts."""
    part = np.array([[0.01, 0.005, 0.001], [0.02, 0.015, 0.003]])
    low, high = part
    middle, (length, width, _) = 0.5 * (low + high), high - low
    outside, pair = MUSCLE.evaluate(40e3), Protocol.pairwise(4)
    plain = pair.measure(ForwardModel(SMALL, "fast").impedance())
    bare = pair.measure(impedances_by_boxes((outside, outside), part))
    assert plain == pytest.approx(bare, rel=0.012)
    for inside in (2.0 * outside, 100.0 * np.real(outside) - 0.1j):
        box = Inclusion.box(*middle[:2], length, width, inside)
        box = dataclasses.replace(box, low=low[2], high=high[2])
        model = ForwardModel(SMALL, "fast", inclusions=[box])
        change = pair.measure(model.impedance()) - plain
        expected = pair.measure(impedances_by_boxes((outside, inside), part)) - bare
        assert np.abs(change - expected).max() < 0.01 * np.abs(expected).max()
