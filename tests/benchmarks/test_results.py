"""Results of benchmarks: written, read, published, entered and run in turn."""

import csv
import hashlib
import json
import math
import multiprocessing
import re
import signal
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from command_line import run
from typer.testing import CliRunner

from eitskin.benchmarks import results as suite
from eitskin.benchmarks import transfer
from eitskin.benchmarks.leaderboard import (
    SEED,
    TRACKS,
    VERSION,
    Leaderboard,
    enter,
    frames_digest,
    read_leaderboard,
    write_leaderboard,
)
from eitskin.benchmarks.methods import FRAMES, SPECIMENS, small_recipe
from eitskin.benchmarks.paper import scores as paper_sets
from eitskin.benchmarks.result_pages import (
    PUBLISHED_FOLDER,
    full_results,
    pages,
    result_section,
    rewritten,
    with_figures,
)
from eitskin.benchmarks.results import (
    ALL,
    Benchmark,
    Report,
    ReportTable,
    Results,
    found_results,
    make_results,
    read_results,
    run_all,
    write_index,
)
from eitskin.benchmarks.transfer import WORLDS
from eitskin.cli.main import app
from eitskin.datasets import Recipe
from eitskin.errors import ConfigurationError, DataError
from eitskin.provenance import Provenance

PICTURE = {"p.png": lambda path: path.write_bytes(b"p")}


def made(figures=None, name="one", **changes):
    known = figures or {"a": 1.5, "b": 2.0}
    results = Results(name, f"eitskin bench {name}", Provenance.now(0), 3.0, False, known)
    return replace(results, **changes)


def test_results_are_read_as_written_but_for_figures_that_are_no_number(tmp_path):
    results = made()
    paths = Report(results, plots=PICTURE).write(tmp_path)
    assert [path.name for path in paths] == ["p.png", "table.csv", "results.json"]
    assert read_results(tmp_path / "one" / "results.json") == results
    comment, *lines = (tmp_path / "one" / "table.csv").read_text().splitlines()
    assert comment == f"# {results.provenance}"
    rows = [{"figure": "a", "value": "1.5"}, {"figure": "b", "value": "2.0"}]
    assert list(csv.DictReader(lines)) == rows
    Report(made(name="two", quick=True)).write(tmp_path)
    (tmp_path / "frames").mkdir()  # no results in it
    assert [each.name for each in found_results(tmp_path)] == ["one", "two"]
    text = write_index(tmp_path).read_text()
    for part in ("| one | 2 | 3 | 0 | ", "| two, quick | 2 |", "[p.png](one/p.png)"):
        assert part in text
    figures = {"a": 1.0, "b": math.nan, "c": math.inf}
    assert make_results("one", figures.items(), began=0.0).figures == {"a": 1.0}


def test_a_picture_that_fails_leaves_no_results_that_vouch_for_it(tmp_path):
    def broken(path):
        path.write_bytes(b"half")
        raise OverflowError

    with pytest.raises(OverflowError):
        Report(made(), plots={"p.png": broken}).write(tmp_path)
    assert list((tmp_path / "one").iterdir()) == []


@pytest.mark.parametrize("text", ['{"name": "half', '{"name": 3}'])
def test_results_that_cannot_be_read_are_refused_with_what_to_do(tmp_path, text):
    path = tmp_path / "results.json"
    path.write_text(text)
    with pytest.raises(DataError, match="--fresh"):
        read_results(path)


def test_numbers_of_a_table_are_figures_by_title_row_and_heading():
    heads = ("board", "frames/s", "ms: p50 (p99)")
    rows = [("fast", "1,297.4", "2.56 (9.01)"), ("slow", "full queue", "2.0e-3")]
    assert dict(ReportTable(heads, rows).figures("times")) == {
        "times / fast / frames/s": 1297.4,
        "times / fast / ms: p50 (p99)": 2.56,
        "times / slow / ms: p50 (p99)": 2.0e-3,
    }
    columns = {"row": ("name", "", 1), "a [%]": ("a", ".1f", 100.0)}
    values = [{"name": "error", "a": 0.01}, {"name": "error", "a": None}, {"name": "  of it"}]
    table = ReportTable.from_rows(values, columns)
    assert table.rows == [("error", "1.0"), ("error", ""), ("  of it", "")]
    assert dict(table.figures()) == {"error / a [%]": 1.0}


# Pages

PAGE = "| | published | ours |\n|---|---|---|\n| one touch | 4.8 mm | 1.1 mm |\n"
KEYS = {"one touch": ["", "touch.error_mm"]}


def test_pages_show_what_is_published_as_figures_and_tables():
    for page, text in pages(full_results()).items():
        assert page.read_text(encoding="utf-8") == text, "run `make pages`"
    assert with_figures(PAGE, KEYS, made({"touch.error_mm": 1.14})) == PAGE
    changed = with_figures(PAGE, KEYS, made({"touch.error_mm": 2.26}))
    assert changed == PAGE.replace("1.1 mm", "2.3 mm")
    assert (rewritten("18.6", 9.04), rewritten("4,311", 12345.6)) == ("9.0", "12,346")
    for keys in ({"two touches": []}, {"one touch": ["", "touch.none"]}):
        with pytest.raises(ConfigurationError, match="quoted"):
            with_figures(PAGE, keys, made({"touch.error_mm": 1.0}))
    figures = {"a / x [mm]": 1.5, "a / y": 2.0, "b / x [mm]": 3.0, "time.p50": 4.0, "c / y": 5.0}
    page = result_section(made(figures | {"a / y +-": 0.25}), "T", shown="[^c].*")
    assert "| | x [mm] | y |\n|---|---|---|\n| a | 1.5 | 2 ± 0.25 |\n| b | 3 |  |\n" in page
    assert "| | p50 |\n|---|---|\n| time | 4 |\n" in page
    assert "eitskin bench one" in page


# The suite that runs them


OTHER, OWN = Benchmark("other", 1.0), Benchmark("own", 1.0, seeded=True)
BOTH = (OTHER, OWN)


class Started:
    """Commands that were started, and what each leaves behind."""

    def __init__(self, out, status=0):
        self.out, self.status, self.commands = out, status, []

    def __call__(self, command):
        self.commands.append(list(command))
        if not self.status:
            seed = int(command[command.index("--seed") + 1]) if "--seed" in command else 0
            name, quick = command[command.index("bench") + 1], "--quick" in command
            changes = {"provenance": Provenance.now(seed), "quick": quick}
            Report(made(name=name, **changes)).write(self.out)
        return self.status


def outcomes(out, benchmarks=BOTH, *, status=0, seed=0, **options):
    """Outcomes of all benchmarks by name, and the commands that were started."""
    start, given = Started(out, status), {"quick": False, "fresh": False, "data": out / "data"}
    done = run_all(benchmarks, out, seed, start=start, **(given | options))
    return {each.name: each.outcome for each in done}, start.commands


MEASURED = dict.fromkeys(("other", "own"), "measured")


def test_each_runs_in_turn_and_is_kept_unless_seed_or_wish_are_others(tmp_path):
    done, (first, second) = outcomes(tmp_path, seed=4)
    assert done == MEASURED
    assert first[3:] == ["bench", "other", "--out", str(tmp_path)]
    assert second[3:] == ["bench", "own", "--seed", "4", "--out", str(tmp_path)]
    assert outcomes(tmp_path, seed=4) == (dict.fromkeys(MEASURED, "kept"), [])
    assert outcomes(tmp_path, seed=4, fresh=True)[0] == MEASURED
    assert outcomes(tmp_path, seed=1)[0] == {"other": "kept", "own": "measured"}
    (tmp_path / "own" / "results.json").write_text("{")
    assert outcomes(tmp_path, seed=1)[0]["own"] == "measured"


def test_quick_runs_are_marked_and_take_the_place_of_no_whole_one(tmp_path):
    done, commands = outcomes(tmp_path, quick=True)
    assert done == MEASURED
    assert all(command[-1] == "--quick" for command in commands)
    assert read_results(tmp_path / "other" / "results.json").quick
    assert outcomes(tmp_path)[0] == MEASURED


def test_what_needs_data_is_left_out_without_it(tmp_path):
    needy = [replace(OWN, options=("--data", "{data}"), needs="{data}/tank.mat")]
    assert outcomes(tmp_path, needy)[0] == {"own": "left out"}
    assert outcomes(tmp_path, needy, data=None)[0] == {"own": "left out"}
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "tank.mat").write_text("")
    done, ((*_, last),) = outcomes(tmp_path, needy)
    assert (done, last) == ({"own": "measured"}, str(tmp_path / "data"))


def test_the_command_ends_with_1_where_one_failed_and_writes_the_index(tmp_path, monkeypatch):
    monkeypatch.setattr(suite, "ALL", BOTH)

    def run(status, *options):
        monkeypatch.setattr(suite, "run_process", Started(tmp_path, status))
        given = ("bench", "all", "--out", str(tmp_path), "--json", "--quiet", *options)
        done = CliRunner().invoke(app, given)
        names = [each["name"] for each in json.loads(done.stdout or "{}").get("benchmarks", ())]
        return done.exit_code, names, type(done.exception)

    assert run(0)[:2] == (0, ["other", "own"])
    assert "| own |" in (tmp_path / "index.md").read_text()
    assert run(2, "--fresh")[:2] == (1, ["other", "own"])
    assert run(0, "--only", "own")[1] == ["own"]
    assert run(0, "--only", "gone")[2] is ConfigurationError
    (tmp_path / "third").mkdir()
    (tmp_path / "third" / "results.json").write_text("{")
    assert run(0)[1:] == (["other", "own"], DataError)
    monkeypatch.setattr(suite, "LONG", 0.5)
    assert run(0)[1] == []
    assert run(0, "--long")[1] == ["other", "own"]


def test_a_signal_ends_what_runs_and_the_command(tmp_path, monkeypatch):
    monkeypatch.setattr(suite, "run_process", lambda *_: signal.raise_signal(signal.SIGTERM))
    ended = CliRunner().invoke(app, ["bench", "all", "--out", str(tmp_path), "--only", "speed"])
    assert ended.exit_code == 130
    assert not list(tmp_path.glob("*/results.json"))


def test_every_benchmark_is_a_command_that_takes_its_options():
    group = typer.main.get_command(app).commands["bench"]
    for each in ALL:
        command = group.commands[each.name]
        words = each.arguments(dict.fromkeys(("out", "data"), "X"), 0, quick=True)[2:]
        command.make_parser(command.context_class(command)).parse_args(words)
    assert {each.name for each in ALL} | {"all"} == set(group.commands)


# Entries of SkinBench


ROOT = Path(__file__).parents[2]
FROZEN = ROOT / "benchmarks" / "skinbench" / "recipes"
RECORDED = "recordings"  # the name of their results
TRACK = {track.results: track for track in TRACKS}


def made_today():
    """Recipes of the frames of each track, by the benchmarks that make them."""
    pairs = (transfer.recipes(world, SEED, quick=False) for world in transfer.WORLDS)
    return {
        "unseen": dict(paper_sets.recipes(SEED, quick=False)),
        "transfer": {recipe.name: recipe for pair in pairs for recipe in pair},
        "common": {"frames": small_recipe(FRAMES, SPECIMENS)},
    }


@pytest.mark.slow
def test_recipes_are_frozen():
    for track, recipes in made_today().items():
        kept = {path.stem: Recipe.from_toml(path) for path in (FROZEN / track).iterdir()}
        today = {re.sub("[ ,]+", "-", name): recipe for name, recipe in recipes.items()}
        assert set(kept) == set(today), track
        for name, recipe in kept.items():
            assert recipe == today[name], f"{track}/{name}: other frames need another VERSION"


def test_figures_become_scores_and_a_run_again_replaces_its_entries():
    figures = {}
    for number, world in enumerate(WORLDS):
        start = f"my:Net / {world}, 0 angles / "
        figures[f"{start}angle, rms [deg]"] = 2.0 + number
        figures[f"{start}touches found"] = 0.9 - 0.1 * number
        figures[f"{start}place, error over standard error"] = 9.0
    ((name, scores),) = TRACK["transfer"].rows(figures)
    assert name == "my:Net"
    assert scores["as it is: angle"] == 2.0 + len(WORLDS) - 1
    assert scores["as it is: found"] == pytest.approx(90.0 - 10.0 * (len(WORLDS) - 1))
    assert set(scores) == {"as it is: angle", "as it is: found"}
    first = Leaderboard().with_results(made({"400 / maps": 3.0, "400 / ridge": 19.0}, RECORDED))
    other = first.with_results(made({"400 / maps": 4.0}, RECORDED, command="eitskin bench other"))
    again = other.with_results(made({"400 / maps": 2.0, "5 / few": 3.0}, RECORDED))
    assert [each.scores.get("400 presses") for each in again.entries] == [2.0, 4.0, 19.0, None]
    table = again.table(TRACK[RECORDED]).splitlines()
    assert table[2].startswith("| maps | 2.00 |  |")
    assert all(line.count("|") == table[0].count("|") for line in table)


def test_the_file_is_read_as_written_is_that_of_the_results_and_others_are_refused(tmp_path):
    path = tmp_path / "board.json"
    board = Leaderboard().with_results(made({"50 / maps": 3.0}, RECORDED), "f00d", {"maps": "c0de"})
    write_leaderboard(path, board)
    assert read_leaderboard(path) == board
    assert (board.entries[0].frames, board.entries[0].code) == ("f00d", "c0de")
    document = json.loads(path.read_text())
    for wrong in (document | {"version": VERSION + 1}, {"entries": 3}, ["no"]):
        path.write_text(json.dumps(wrong))
        with pytest.raises(DataError):
            read_leaderboard(path)
    board = read_leaderboard(ROOT / "docs" / "results" / "leaderboard.json")
    files = [PUBLISHED_FOLDER / track.results / "results.json" for track in TRACKS]
    for path in files:
        assert board.with_results(read_results(path)) == board
    published = {read_results(path).command for path in files}
    assert published <= {entry.command for entry in board.entries}


def test_a_benchmark_enters_its_results_with_the_digests_of_frames_and_code(tmp_path, monkeypatch):
    start = "my:Net / {}, 0 angles / place, mean [mm]"
    found = made({start.format(world): 2.5 for world in WORLDS}, "transfer")
    monkeypatch.setattr(transfer, "run", lambda *_: Report(found, tables=[ReportTable((), [])]))
    (tmp_path / "transfer").mkdir()
    manifest, code = tmp_path / "transfer" / "manifest.json", tmp_path / "my.py"
    manifest.write_text("{}")
    board = tmp_path / "board.json"
    words = ["bench", "transfer", "mine.eitmodel", "--out", tmp_path, "--leaderboard", board]
    assert run(*words).exit_code == 0
    (entry,) = read_leaderboard(board).entries
    assert entry.scores == {"as it is: place": 2.5}
    assert entry.frames == frames_digest(tmp_path / "transfer")
    manifest.write_text("{ }")
    assert entry.frames != frames_digest(tmp_path / "transfer")
    code.write_text("class Net: ...\n")
    enter(board, found, tmp_path / "transfer", {"my:Net": f"{code}:Net"})
    codes = {each.code for each in read_leaderboard(board).entries}
    assert codes == {"", hashlib.sha256(code.read_bytes()).hexdigest()}


@pytest.mark.parametrize("words", [["--quick"], ["--seed", "1"]])
def test_a_run_that_is_no_entry_is_refused_before_the_work(tmp_path, words):
    with pytest.raises(ConfigurationError):
        run("bench", "transfer", "--out", tmp_path, "--leaderboard", tmp_path / "a.json", *words)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux")
def test_peak_memory_is_that_of_a_process_without_its_parents():
    block = np.ones(60_000_000)
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        alone = pool.submit(suite.peak_memory_mb).result()
    assert alone < 400 < 1e-6 * block.nbytes <= suite.peak_memory_mb()
