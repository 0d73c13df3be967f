"""`eitskin bench all`: what runs, what is kept, and what becomes of failures."""

import json
import signal
from dataclasses import replace

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
        if not self.status:
            seed = int(command[command.index("--seed") + 1]) if "--seed" in command else 0
            name, quick = command[command.index("bench") + 1], "--quick" in command
            made = Results(name, "", Provenance.now(seed), 1.0, quick, {"a": 1.0})
            Report(made).write(self.out)
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
