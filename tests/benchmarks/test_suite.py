"""`eitskin bench all`: what runs, what is kept, and what becomes of failures."""

import json
import signal
from dataclasses import replace
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from eitskin.benchmarks import suite
from eitskin.benchmarks.results import Report, Results, read_results
from eitskin.benchmarks.suite import ALL, Benchmark, run_all
from eitskin.cli.main import app
from eitskin.errors import ConfigurationError, DataError
from eitskin.provenance import Provenance

OTHER, OWN = Benchmark("other", 1.0), Benchmark("own", 1.0, seeded=True)
BOTH = (OTHER, OWN)


class Started:
    """Commands that were started, and what each leaves behind."""

    def __init__(self, out, status=0):
        self.out, self.status, self.commands = out, status, []

    def __call__(self, command):
        self.commands.append(list(command))
        if self.status:
            return self.status
        seed = int(command[command.index("--seed") + 1]) if "--seed" in command else 0
        name, quick = command[command.index("bench") + 1], "--quick" in command
        made = Results(name, "", Provenance.now(seed), 1.0, quick, {"a": 1.0})
        Report(made).write(self.out)
        return 0


def outcomes(out, start, benchmarks=BOTH, seed=0, **options):
    given = {"quick": False, "fresh": False, "data": Path("data")} | options
    return {
        done.name: done.outcome for done in run_all(benchmarks, out, seed, start=start, **given)
    }


def test_each_runs_in_turn_and_leaves_results(tmp_path):
    start = Started(tmp_path)
    assert set(outcomes(tmp_path, start, seed=4).values()) == {"measured"}
    first, second = start.commands
    assert first[3:] == ["bench", "other", "--out", str(tmp_path)]
    assert second[3:] == ["bench", "own", "--seed", "4", "--out", str(tmp_path)]
    assert read_results(tmp_path / "own" / "results.json").provenance.seed == 4


def test_what_is_there_is_kept_unless_seed_or_wish_are_others(tmp_path):
    outcomes(tmp_path, Started(tmp_path))
    again = Started(tmp_path)
    assert set(outcomes(tmp_path, again).values()) == {"kept"}
    assert again.commands == []
    assert outcomes(tmp_path, again, fresh=True)["own"] == "measured"
    assert outcomes(tmp_path, again, seed=1) == {"other": "kept", "own": "measured"}


def test_results_that_are_broken_are_made_again(tmp_path):
    outcomes(tmp_path, Started(tmp_path))
    (tmp_path / "own" / "results.json").write_text("{")
    assert outcomes(tmp_path, Started(tmp_path))["own"] == "measured"


def test_a_failure_is_named_and_the_next_one_runs(tmp_path):
    start = Started(tmp_path, status=3)
    done = list(run_all(BOTH, tmp_path, 0, quick=False, fresh=False, data=tmp_path, start=start))
    assert [(each.outcome, each.why) for each in done] == [("failed", "exit status 3")] * 2
    assert not list(tmp_path.glob("*/results.json"))


def test_quick_runs_are_marked_and_take_the_place_of_no_whole_one(tmp_path):
    start = Started(tmp_path)
    assert set(outcomes(tmp_path, start, quick=True).values()) == {"measured"}
    assert all(command[-1] == "--quick" for command in start.commands)
    assert read_results(tmp_path / "other" / "results.json").quick
    assert set(outcomes(tmp_path, Started(tmp_path)).values()) == {"measured"}


def test_what_needs_data_is_left_out_without_it(tmp_path):
    needy = replace(OWN, options=("--data", "{data}"), needs="{data}/tank.mat")
    start = Started(tmp_path)
    assert outcomes(tmp_path, start, [needy], data=tmp_path / "data") == {"own": "left out"}
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "tank.mat").write_text("")
    assert outcomes(tmp_path, start, [needy], data=tmp_path / "data") == {"own": "measured"}
    assert start.commands[0][-1] == str(tmp_path / "data")


@pytest.fixture
def ran(tmp_path, monkeypatch):
    """The command itself over both benchmarks, with a status of its own."""

    def run(status=0, *options):
        monkeypatch.setattr(suite, "ALL", BOTH)
        monkeypatch.setattr(suite, "run_process", Started(tmp_path, status))
        given = ("bench", "all", "--out", str(tmp_path), "--json", "--quiet", *options)
        return CliRunner().invoke(app, given)

    return run


def test_the_command_ends_with_1_where_one_failed_and_writes_the_index(ran, tmp_path):
    done = ran()
    assert done.exit_code == 0
    index = (tmp_path / "index.md").read_text()
    assert "| own |" in index
    assert "left out" not in index
    failed = ran(2, "--fresh")
    assert failed.exit_code == 1
    names = [each["name"] for each in json.loads(failed.stdout)["benchmarks"]]
    assert names == ["other", "own"]


def test_a_signal_ends_what_runs_and_the_command(tmp_path, monkeypatch):
    def ends(*_):
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(suite, "run_process", ends)
    ended = CliRunner().invoke(app, ["bench", "all", "--out", str(tmp_path), "--only", "speed"])
    assert ended.exit_code == 130
    assert not list(tmp_path.glob("*/results.json"))


def test_broken_results_of_others_hide_nothing(ran, tmp_path):
    (tmp_path / "third").mkdir()
    (tmp_path / "third" / "results.json").write_text("{")
    done = ran()
    assert isinstance(done.exception, DataError)
    assert len(json.loads(done.stdout)["benchmarks"]) == 2


def test_one_can_be_chosen_and_others_are_refused_by_name(ran):
    said = json.loads(ran(0, "--only", "own").stdout)["benchmarks"]
    assert [each["name"] for each in said] == ["own"]
    refused = ran(0, "--only", "gone")
    assert isinstance(refused.exception, ConfigurationError)
    assert "no benchmark 'gone'; there are: other, own" in str(refused.exception)


def test_long_ones_run_when_they_are_asked_for(ran, monkeypatch):
    monkeypatch.setattr(suite, "LONG", 0.5)
    assert json.loads(ran().stdout)["benchmarks"] == []
    assert len(json.loads(ran(0, "--long").stdout)["benchmarks"]) == 2


def test_every_benchmark_is_a_command_that_takes_its_options():
    group = typer.main.get_command(app).commands["bench"]
    for each in ALL:
        command = group.commands[each.name]
        words = each.arguments(dict.fromkeys(("out", "own", "data"), "X"), 0, quick=True)[2:]
        command.make_parser(command.context_class(command)).parse_args(words)
