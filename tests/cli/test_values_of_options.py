"""Values of options and files that no library may see unchecked: refused in words, or taken."""

import json
import math

import pytest
from command_line import run

from eitskin.cli import entry
from eitskin.cli.options import Output
from eitskin.errors import ConfigurationError
from eitskin.hardware import open_board
from eitskin.hardware.streams import parse_address
from eitskin.training import TrainingSettings

LONG = 300 * "a"
SCENE = "[[touches]]\nx = 0.05\ny = 0.02\nforce = 5.0\n"


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(SCENE)
    return path


def test_seeds_are_not_negative(scene):
    assert "--seed" in run("simulate", scene, "--seed", "-5").stderr
    for refused in (
        lambda: TrainingSettings(seed=-5),
        lambda: open_board("virtual:?seed=-5&resolution=coarse"),
    ):
        with pytest.raises(ConfigurationError, match="seed must be from 0"):
            refused()


@pytest.mark.parametrize("host", ["\u202e", LONG, "..", "x\u0000", "x y"])
def test_hosts_are_names_or_numbers(host):
    with pytest.raises(ConfigurationError, match="--udp: expected a name"):
        parse_address("--udp", f"{host}:5")


def test_numbers_that_json_has_not_are_null(capsys):
    Output(as_json=True).result({"a": math.inf, "rows": [{"b": (1.5, math.nan)}]}, "")
    assert json.loads(capsys.readouterr().out) == {"a": None, "rows": [{"b": [1.5, None]}]}


def test_a_name_too_long_for_a_file_is_no_fault_of_the_program(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["eitskin", "check", "--recording", LONG])
    with pytest.raises(SystemExit) as ending:
        entry.run()
    assert ending.value.code == ConfigurationError.exit_code
    assert "File name too long" in capsys.readouterr().err
