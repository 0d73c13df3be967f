"""What commands refuse, and how they print what they were given."""

import io
import json
import math
import re
import time
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import run
from rich.progress import Progress
from rich.table import Table

from eitskin.benchmarks.results import ReportTable
from eitskin.cli import entry
from eitskin.cli.options import Output, Terminal
from eitskin.datasets import Dataset, save_dataset
from eitskin.errors import ConfigurationError, DataError, DeviceError, FrameError
from eitskin.geometry import SensorDesign
from eitskin.simulator import Protocol

import small_dataset

MODEL = "reference.eitmodel"
DISC = "outline = { radius = 0.03 }\nthickness = 0.004\n[electrodes]\ncount = 6\n"
RECIPE = 'name = "cheap"\nscenes = [{ state = "bend", count = 8, angle_deg = [10, 10] }]\n'
USAGE, DATA, FRAME = ConfigurationError, DataError, FrameError
REFUSALS = [
    # simulate and mesh
    ("simulate touch.toml --support plate", USAGE, r"--support.*'plates'.*got 'plate'"),
    ("simulate touch.toml --fixture wrong.toml", USAGE, r"wrong.toml.*Hinge.*'span'"),
    ("simulate touch.toml --color strain", USAGE, "name the picture with --view"),
    ("simulate touch.toml --drive 0-4", USAGE, "name the picture with --view"),
    ("simulate touch.toml --view a.png --drive 0-4", USAGE, r"--drive.*--color current"),
    ("simulate touch.toml --view a.png --color current --drive 0-8", USAGE, "0 to 7"),
    ("simulate touch.toml --view a.gif", USAGE, "PNG"),
    ("simulate touch.toml --view no/such/a.png", USAGE, "folder"),
    ("mesh --drive 0,4", USAGE, "name the picture with --view"),
    ("mesh --drive 0 --view a.png", USAGE, "as 0-4"),
    ("mesh --drive 3,3 --view a.png", USAGE, "two different electrodes"),
    # reconstruct
    ("reconstruct set --lambda small", USAGE, "expected a rule for lambda"),
    ("reconstruct set --frames 9", USAGE, "from 0 to 5, got '9'"),
    ("reconstruct set --frames x", USAGE, "expected frames as"),
    ("reconstruct set --out a.jpg", USAGE, "as .png, .npz or .csv"),
    ("reconstruct set --out no/a.png", USAGE, "there is no folder"),
    ("reconstruct set --pixels 1", USAGE, "pixels must be"),
    ("reconstruct set --page", USAGE, "--page is for one method on a board"),
    ("reconstruct replay:set --page --method all", USAGE, "--page is for one method"),
    ("reconstruct set --sensor disc.toml", USAGE, "protocol of 6 electrodes"),
    ("reconstruct set --protocol adjacent", FRAME, r"pairwise:8.*leave --protocol out"),
    ("reconstruct bare", DATA, "name the design"),
    ("reconstruct bare --sensor eight.toml", DATA, "--protocol, such as adjacent"),
    ("reconstruct bare --sensor eight.toml --protocol adjacent", FRAME, "40 measurements"),
    ("reconstruct replay:set --average 6 --method noser", DATA, "got none"),
    (f"reconstruct {MODEL}", USAGE, "need no trained pipeline"),
    # datasets
    ("generate absent.toml --out new", USAGE, "absent.toml"),
    ("generate nothing --out new", USAGE, "'nothing'"),
    ("generate cheap.toml --out cheap.toml", USAGE, "cheap.toml"),
    ("generate cheap.toml --out .", USAGE, "is not empty"),
    ("generate cheap.toml --out new --scheduler x", USAGE, "dask scheduler.*'x'"),
    ("generate cheap.toml --out new --scheduler tcp://127.0.0.1:1", USAGE, "dask scheduler"),
    ("generate cheap.toml --out new --scheduler x --shard 0", USAGE, "got both"),
    ("generate cheap.toml --out new --shard -1", USAGE, r"0 to 0.*shard -1"),
    ("import log.csv --out new --column force", USAGE, "LABEL=PLACE"),
    ("export vtu touch.toml --out set", USAGE, "not empty"),
    (f"export onnx {MODEL} --out graphs", USAGE, r"eitskin\[live\]"),
    # pipelines of one's own sensor
    ("train set --out made.eitmodel", USAGE, "--replace"),
    ("train set --out a.eitmodel --report set", USAGE, "no report"),
    (f"evaluate {MODEL} set --out set", USAGE, "no report"),
    ("adapt none set --out made.eitmodel", USAGE, "--replace"),
    ("adapt none two --out a.eitmodel", USAGE, "2 specimens"),
    ("adapt none two --specimen 7 --out a.eitmodel", USAGE, "--specimen 7"),
    ("adapt none two --specimen 0 --out a.eitmodel", DATA, "at least 5"),
    ("adapt none bare --twin . --specimen 0 --out a.eitmodel", USAGE, "--twin"),
    (f"adapt {MODEL} ring --out a.eitmodel", FRAME, "trained for pairwise:8"),
    (f"live {MODEL} --board virtual:?protocol=adjacent", FRAME, "trained for pairwise:8"),
    (f"calibrate {MODEL} --board virtual: --out made.eitmodel", USAGE, "--replace"),
    (f"calibrate {MODEL} --board virtual: --angles a --out a.eitmodel", USAGE, "by commas"),
    (f"setup {MODEL} --board virtual: --out made.eitmodel", USAGE, "--replace"),
    (f"setup {MODEL} --board virtual: --out my.eitmodel", USAGE, r"my-frames exists.*adapt"),
    (f"tare {MODEL} --out r.json", USAGE, "--dataset"),
    (f"tare {MODEL} --board virtual: --out no/r.json", USAGE, "there is no folder"),
    (f"tare {MODEL} --dataset set --specimen 7 --out r.json", DATA, "expected specimen 7"),
    (f"check {MODEL} --recording set", USAGE, "without a model"),
    ("check --protocol adjacent", USAGE, "describe a --recording"),
    (f"live {MODEL} --board nothing", USAGE, "board"),
    (f"live {MODEL} --board serial:/dev/none", DeviceError, "/dev/none"),
    (f"live {MODEL} --board serial:/dev/none --page --page-host no.invalid", USAGE, "address"),
    (
        f"live {MODEL} --board serial:/dev/none --page --page-token-file log.csv",
        USAGE,
        "view TOKEN",
    ),
    (f"live {MODEL} --board virtual: --mcap log.csv --record new", USAGE, "mcap"),
    # fits
    ("instrument fit flat.toml ring --out a.toml --first 2", USAGE, "frames to test on"),
    ("instrument fit flat.toml ring --out no/a.toml", USAGE, "there is no folder"),
    ("instrument fit flat.toml missing --out a.toml", DATA, r"no dataset and no file .*missing"),
    ("instrument fit disc.toml ring --out a.toml", USAGE, "design of the sensor"),
    ("instrument fit flat.toml bare --out a.toml", USAGE, "--protocol"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Files and datasets that the calls name."""
    made = tmp_path_factory.mktemp("refused")
    texts = {
        "touch.toml": "[[touches]]\nx = 0.05\ny = 0.02\n",
        "wrong.toml": "spam = 0.05\n",
        "disc.toml": DISC,
        "eight.toml": DISC.replace("6\n", "8\n"),
        "cheap.toml": RECIPE,
        "log.csv": "v0,v1\n1,2\n",
    }
    for name, text in texts.items():
        (made / name).write_text(text)
    SensorDesign.reference().to_toml(made / "flat.toml")
    sound = np.zeros((6, 28))
    save_dataset(small_dataset.make(n=6, status=sound), made / "set")
    save_dataset(small_dataset.make(n=6, design=None, protocol=None), made / "bare")
    two = Dataset.from_arrays(np.ones((4, 28)), np.ones((2, 28)), specimen=[0, 0, 1, 1])
    save_dataset(two, made / "two")
    ring = Dataset.from_arrays(np.ones((2, 64)), protocol=Protocol.adjacent(8, shared=True))
    save_dataset(ring, made / "ring")
    (made / "made.eitmodel").mkdir()
    (made / "made.eitmodel" / "SHA256SUMS").write_text("that of a pipeline")
    (made / "my-frames").mkdir()
    return made


@pytest.mark.slow
@pytest.mark.parametrize(("call", "error", "remedy"), REFUSALS)
def test_a_command_refuses_in_words_and_leaves_nothing(folder, monkeypatch, call, error, remedy):
    monkeypatch.chdir(folder)
    before = sorted(folder.rglob("*"))
    with pytest.raises(error, match=remedy):
        run(*call.split())
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize("call", ["generate quick --out a --workers 0", "live", "nothing"])
def test_options_that_are_none_are_usage_errors(call):
    assert run(*call.split()).exit_code == 2


@pytest.mark.parametrize(
    ("words", "choice"),
    [
        ("mesh --cells cubes", "hexahedra"),
        ("simulate a.toml --resolution finest", "standard"),
        ("simulate a.toml --seed -5", "--seed"),
    ],
)
def test_a_value_that_is_no_choice_is_refused_with_the_choices(words, choice):
    ran = run(*words.split())
    assert ran.exit_code == 2
    assert choice in ran.stderr


# Values of options and what is printed


LONG = 300 * "a"


def test_json_holds_no_number_or_name_that_it_has_not(capsys):
    Output(as_json=True).result({"a": math.inf, "rows": [{"b": (1.5, math.nan)}]}, "")
    assert json.loads(capsys.readouterr().out) == {"a": None, "rows": [{"b": [1.5, None]}]}
    console = Terminal(file=io.StringIO(), width=200)
    Output(as_json=True, console=console).result({"name": HOSTILE + "µ"}, "")
    said = console.file.getvalue()
    assert json.loads(said) == {"name": HOSTILE + "µ"}
    assert said.replace("\n", "").isprintable()


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


@pytest.mark.parametrize(("width", "parts"), [(200, 1), (40, 2), (24, 4), (5, 4)])
def test_a_table_of_figures_goes_on_below_where_it_is_too_wide(width, parts):
    headings = ("experiment", "paper's", "theirs", "ours[mm]", "bound")
    rows = [
        ("one touch", "4.80 +- 2.80", "2.5", "1.38", "0.9"),
        ("two", "5.5", "2.9", "1.5", "0.9"),
    ]
    console = Terminal(file=io.StringIO(), width=width)
    console.print(ReportTable(headings, rows))
    lines = console.file.getvalue().splitlines()
    assert max(map(len, lines)) <= width
    if width > 10:
        assert sum(line.split()[:1] == ["two"] for line in lines) == parts
        said = "".join(lines)
        assert all(cell in said for row in (headings, *rows) for cell in row if " " not in cell)
