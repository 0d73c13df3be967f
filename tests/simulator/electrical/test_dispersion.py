"""Conductivities by the frequency, against closed forms, published values and other elements."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from eitskin.datasets import Recipe
from eitskin.datasets.generation.shard_simulation import simulate_frames
from eitskin.geometry import (
    Bend,
    ColeCole,
    ConductivityTable,
    Electrode,
    Layer,
    Rectangle,
    SensorDesign,
)
from eitskin.simulator import ForwardModel, Protocol, Scene, Simulator, Touch

pytestmark = pytest.mark.slow

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
