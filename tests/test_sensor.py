"""Sensor designs: the reference, TOML in and out, and what is refused."""

import dataclasses
import itertools

import pytest

from eitskin.geometry import ConfigurationError, Electrode, Rectangle, SensorDesign


def test_reference_is_the_sensor_of_the_paper() -> None:
    design = SensorDesign.reference()
    assert (design.outline.length, design.outline.width, design.thickness) == (0.150, 0.060, 0.005)
    assert [design.side(i) for i in range(8)] == [0, 0, 0, 1, 2, 2, 2, 3]
    centres = [sum(design.perimeter_span(i)) / 2 for i in range(8)]
    steps = [b - a for a, b in itertools.pairwise(centres)]
    assert steps == pytest.approx([0.0525] * 7)


def test_toml_round_trip(tmp_path) -> None:
    design = dataclasses.replace(SensorDesign.reference(), conductivity=0.73)
    path = tmp_path / "sensor.toml"
    path.write_text(design.to_toml())
    assert SensorDesign.from_toml(path) == design


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("thickness = 0.005", "missing required field `outline`"),
        ("thicknes = 0.005", "did you mean 'thickness'"),
        ("thickness = 'thin'", "Expected `float`, got `str`"),
        ("thickness = ", "not valid TOML"),
    ],
)
def test_unreadable_designs_say_why(tmp_path, text, message) -> None:
    path = tmp_path / "sensor.toml"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=message):
        SensorDesign.from_toml(path)


def test_a_missing_file_is_named(tmp_path) -> None:
    with pytest.raises(ConfigurationError, match=r"none\.toml"):
        SensorDesign.from_toml(tmp_path / "none.toml")


@pytest.mark.parametrize(
    ("electrodes", "message"),
    [
        ((Electrode(0.02, 0.0), Electrode(0.022, 0.0)), "electrodes 0 and 1 overlap by 3 mm"),
        (
            (Electrode(0.02, 0.01), Electrode(0.05, 0.0)),
            "must lie wholly on one side",
        ),
        ((Electrode(0.001, 0.0), Electrode(0.05, 0.0)), "passes a corner"),
        ((Electrode(0.02, 0.0),), "at least two electrodes"),
    ],
)
def test_impossible_electrodes_are_refused(electrodes, message) -> None:
    with pytest.raises(ConfigurationError, match=message):
        SensorDesign(Rectangle(0.1, 0.05), 0.005, electrodes)


@pytest.mark.parametrize("thickness", [0.0, -1.0, float("nan"), float("inf")])
def test_nonsense_sizes_are_refused(thickness) -> None:
    with pytest.raises(ConfigurationError, match="thickness must be a positive number"):
        dataclasses.replace(SensorDesign.reference(), thickness=thickness)
