"""`eitskin simulate`: numbers, protocols, and what is refused."""

import json

import pytest
from typer.testing import CliRunner

from eitskin.cli.main import app
from eitskin.geometry import ConfigurationError
from eitskin.simulator import Protocol


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text("[[touches]]\nx = 0.05\ny = 0.02\n")
    return path


def simulate(scene, *options) -> dict:
    ran = CliRunner().invoke(
        app, ["simulate", str(scene), "--resolution", "fast", "--json", *options]
    )
    if ran.exception is not None:
        raise ran.exception
    return json.loads(ran.stdout)


def test_adjacent_values_are_sums_of_pairwise_ones(scene, tmp_path) -> None:
    Protocol(((0, 1, 2, 3),), 8).to_file(tmp_path / "one.csv")
    pairs = simulate(scene)
    R = dict(zip(pairs["measurements"], pairs["impedance_real_ohm"], strict=True))
    one = simulate(scene, "--protocol", str(tmp_path / "one.csv"))
    # Z_ij = (Z_ii + Z_jj - R_ij) / 2, so the diagonal drops out of a four-electrode value.
    expected = 0.5 * (R["0-3"] + R["1-2"] - R["0-2"] - R["1-3"])
    assert one["measurements"] == ["0-1/2-3"]
    assert one["impedance_real_ohm"][0] == pytest.approx(expected)
    assert pairs["independent"] == 28
    assert one["independent"] == 1


def test_a_value_that_is_zero_by_symmetry_has_no_relative_change(scene, tmp_path) -> None:
    # Electrodes 7 and 3 are the middles of the short sides, 1 and 5 of the long ones.
    Protocol(((1, 5, 3, 7), (1, 5, 1, 5)), 8).to_file(tmp_path / "symmetric.csv")
    found = simulate(scene, "--protocol", str(tmp_path / "symmetric.csv"))
    assert found["relative_change"][0] is None
    before = found["impedance_real_ohm"][1] - found["change_ohm"][1]
    assert found["relative_change"][1] == pytest.approx(found["change_ohm"][1] / before)
    assert abs(found["change_ohm"][0]) > 1e-3


def test_an_unknown_protocol_is_refused(scene) -> None:
    with pytest.raises(ConfigurationError, match="expected a protocol"):
        simulate(scene, "--protocol", "neighbours")
