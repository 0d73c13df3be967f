"""Values that no library or terminal may see unchecked: refused in words, taken, or shown."""

import io
import json
import math
import re
import time
from types import SimpleNamespace

import pytest
from command_line import run
from rich.progress import Progress
from rich.table import Table

from eitskin.cli import entry
from eitskin.cli.options import Output
from eitskin.cli.terminal import FigureTable, Terminal
from eitskin.errors import ConfigurationError
from eitskin.hardware import open_board
from eitskin.hardware.streams import parse_address
from eitskin.training import TrainingSettings

LONG = 300 * "a"


def test_seeds_are_not_negative():
    assert "--seed" in run("simulate", "scene.toml", "--seed", "-5").stderr
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


def test_an_interrupt_that_a_callback_would_lose_is_raised_again():
    entry.interrupt_again(SimpleNamespace(exc_value=KeyboardInterrupt()))
    with pytest.raises(KeyboardInterrupt):
        time.sleep(10)


# What is printed: text of files and boards shows its control characters, and commands nothing

HOSTILE = "a\x1b]z\x9bb"
SHOWN = r"a\x1b]z\x9bb"


@pytest.fixture
def printed():
    """A terminal with colours, whose file is read back."""
    return Terminal(file=io.StringIO(), force_terminal=True, width=200, color_system="standard")


def test_notes_results_tables_and_progress_show_control_characters(printed):
    output = Output(console=printed, notes=printed)
    table = Table()
    table.add_row(HOSTILE, style="red")
    output.note(HOSTILE)
    output.result({}, HOSTILE)
    output.show(table)
    with Progress("{task.description}", console=printed) as progress:
        progress.add_task(HOSTILE)
    said = printed.file.getvalue()
    plain = re.sub(r"\x1b\[[?\d;]*[a-zA-Z]", "", said)
    assert plain.count(SHOWN) >= 4
    assert plain.replace("\n", "").replace("\r", "").isprintable()
    assert "\x1b[31m" in said  # the table's own red


def test_json_of_hostile_names_is_json():
    console = Terminal(file=io.StringIO(), width=200)
    Output(as_json=True, console=console).result({"name": HOSTILE + "µ"}, "")
    said = console.file.getvalue()
    assert json.loads(said) == {"name": HOSTILE + "µ"}
    assert said.replace("\n", "").isprintable()


@pytest.mark.parametrize(("width", "parts"), [(200, 1), (40, 2), (24, 4), (5, 4)])
def test_a_table_of_figures_goes_on_below_where_it_is_too_wide(width, parts):
    headings = ("experiment", "paper's", "theirs", "ours[mm]", "bound")
    rows = [
        ("one touch", "4.80 +- 2.80", "2.5", "1.38", "0.9"),
        ("two", "5.5", "2.9", "1.5", "0.9"),
    ]
    console = Terminal(file=io.StringIO(), width=width)
    console.print(FigureTable(headings, rows))
    lines = console.file.getvalue().splitlines()
    assert max(map(len, lines)) <= width
    if width > 10:
        assert sum(line.split()[:1] == ["two"] for line in lines) == parts
        said = "".join(lines)
        assert all(cell in said for row in (headings, *rows) for cell in row if " " not in cell)
