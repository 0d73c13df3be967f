"""`eitskin bench all`: what runs, what is kept, and what becomes of failures."""

import json
import signal
from pathlib import Path

import pytest
from typer.testing import CliRunner

from eitskin.benchmarks import suite
from eitskin.benchmarks.results import Results, read_results, write_results
from eitskin.benchmarks.suite import ALL, Benchmark, run_all
from eitskin.cli.main import app
from eitskin.errors import ConfigurationError, DataError
from eitskin.provenance import Provenance

PRINTED = "| what | ms |\n|---|---|\n| a | 1.5 |\n"
PRINTS = Benchmark("prints", "boards", 1.0, ("--whole",), ("--few",), seeded=True)
WRITES = Benchmark("writes", "", 1.0, ("--out", "{own}"), report="report.md")
OWN = Benchmark("own", "", 1.0, ("--out", "{out}"), ("--quick",), own_results=True)
THREE = (PRINTS, WRITES, OWN)


class Started:
    """Commands that were started, and what each leaves behind."""

    def __init__(self, out, status=0):
        self.out, self.status, self.commands = out, status, []

    def __call__(self, command, report):
        self.commands.append(list(command))
        if self.status:
            return self.status
        if report is not None:
            report.write_text(PRINTED)
        elif "writes" in command:
            (self.out / "writes" / "report.md").write_text(PRINTED)
        else:
            write_results(Results("own", "", Provenance.now(0), 1.0, False, {"a": 1.0}), self.out)
        return 0


def outcomes(out, start, benchmarks=THREE, seed=0, **options):
    given = {"quick": False, "fresh": False, "data": Path("data")} | options
    return {
        done.name: done.outcome for done in run_all(benchmarks, out, seed, start=start, **given)
    }


def test_each_runs_in_turn_and_leaves_results(tmp_path):
    start = Started(tmp_path)
    assert set(outcomes(tmp_path, start, seed=4).values()) == {"measured"}
    first, second, third = start.commands
    assert first[1:] == ["-m", "eitskin.benchmarks.studies.boards.prints", "--seed", "4", "--whole"]
    assert second[3:] == ["bench", "writes", "--out", str(tmp_path / "writes")]
    assert third[3:] == ["bench", "own", "--out", str(tmp_path)]
    results = read_results(tmp_path / "prints" / "results.json")
    assert results.figures == {"a / ms": 1.5}
    assert results.command == "python -m eitskin.benchmarks.studies.boards.prints --seed 4 --whole"
    assert results.provenance.seed == 4
    assert (tmp_path / "prints" / "report.md").read_text() == PRINTED
    written = read_results(tmp_path / "writes" / "results.json")
    assert written.figures == {"a / ms": 1.5}
    assert written.command == "eitskin bench writes --out OUT/writes"  # no path of this machine


def test_what_is_there_is_kept_unless_seed_or_wish_are_others(tmp_path):
    outcomes(tmp_path, Started(tmp_path))
    again = Started(tmp_path)
    assert set(outcomes(tmp_path, again).values()) == {"kept"}
    assert again.commands == []
    assert outcomes(tmp_path, again, fresh=True)["own"] == "measured"
    found = outcomes(tmp_path, again, seed=1)
    assert found == {"prints": "measured", "writes": "kept", "own": "kept"}  # they take no seed


def test_results_that_are_broken_are_made_again(tmp_path):
    outcomes(tmp_path, Started(tmp_path))
    (tmp_path / "own" / "results.json").write_text("{")
    assert outcomes(tmp_path, Started(tmp_path))["own"] == "measured"


def test_a_failure_is_named_and_the_next_one_runs(tmp_path):
    start = Started(tmp_path, status=3)
    done = list(run_all(THREE, tmp_path, 0, quick=False, fresh=False, data=tmp_path, start=start))
    assert [(each.outcome, each.why) for each in done] == [("failed", "exit status 3")] * 3
    assert not list(tmp_path.glob("*/results.json"))


def test_a_report_without_figures_is_a_failure(tmp_path):
    def silent(_command, report):
        report.write_text("nothing")
        return 0

    assert outcomes(tmp_path, silent, [PRINTS]) == {"prints": "failed"}


def test_quick_takes_other_options_and_leaves_out_what_has_none(tmp_path):
    start = Started(tmp_path)
    found = outcomes(tmp_path, start, quick=True)
    assert found == {"prints": "measured", "writes": "left out", "own": "measured"}
    assert start.commands[0][-1] == "--few"
    assert read_results(tmp_path / "prints" / "results.json").quick


def test_what_needs_data_is_left_out_without_it(tmp_path):
    needy = Benchmark("needy", "data", 1.0, ("{data}",), needs="{data}/tank.mat")
    start = Started(tmp_path)
    assert outcomes(tmp_path, start, [needy], data=tmp_path / "data") == {"needy": "left out"}
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "tank.mat").write_text("")
    assert outcomes(tmp_path, start, [needy], data=tmp_path / "data") == {"needy": "measured"}
    assert start.commands[0][-1] == str(tmp_path / "data")


@pytest.fixture
def ran(tmp_path, monkeypatch):
    """The command itself over three benchmarks, with a status of its own."""

    def run(status=0, *options):
        monkeypatch.setattr(suite, "ALL", THREE)
        monkeypatch.setattr(suite, "run_process", Started(tmp_path, status))
        given = ("bench", "all", "--out", str(tmp_path), "--json", "--quiet", *options)
        return CliRunner().invoke(app, given)

    return run


def test_the_command_ends_with_1_where_one_failed_and_writes_the_index(ran, tmp_path):
    done = ran()
    assert done.exit_code == 0
    index = (tmp_path / "index.md").read_text()
    assert "| prints |" in index
    assert "left out" not in index
    assert ran(0, "--quick").exit_code == 0
    assert "- `writes` left out: there is no quick run of it" in (tmp_path / "index.md").read_text()
    failed = ran(2, "--fresh")
    assert failed.exit_code == 1
    names = [each["name"] for each in json.loads(failed.stdout)["benchmarks"]]
    assert names == ["prints", "writes", "own"]


def test_a_signal_ends_what_runs_and_the_command(tmp_path, monkeypatch):
    def ends(*_):
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(suite, "run_process", ends)
    ended = CliRunner().invoke(app, ["bench", "all", "--out", str(tmp_path), "--only", "signals"])
    assert ended.exit_code == 130
    assert not list(tmp_path.glob("*/results.json"))


def test_broken_results_of_others_hide_nothing(ran, tmp_path):
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "results.json").write_text("{")
    done = ran()
    assert isinstance(done.exception, DataError)
    assert len(json.loads(done.stdout)["benchmarks"]) == 3


def test_one_can_be_chosen_and_others_are_refused_by_name(ran):
    said = json.loads(ran(0, "--only", "own").stdout)["benchmarks"]
    assert [each["name"] for each in said] == ["own"]
    refused = ran(0, "--only", "gone")
    assert isinstance(refused.exception, ConfigurationError)
    assert "no benchmark 'gone'; there are: prints, writes, own" in str(refused.exception)


def test_long_ones_run_when_they_are_asked_for(ran, monkeypatch):
    monkeypatch.setattr(suite, "LONG", 0.5)
    assert json.loads(ran().stdout)["benchmarks"] == []
    assert len(json.loads(ran(0, "--long").stdout)["benchmarks"]) == 3


def test_every_benchmark_is_a_command_or_a_module_that_takes_its_options():
    """Typer and argparse would refuse an option that is none; they are asked for their help."""
    commands = {each.name for each in app.registered_groups[1].typer_instance.registered_commands}
    folder = Path(suite.__file__).parent / "studies"
    for each in ALL:
        if not each.folder:
            assert each.name in commands
            continue
        source = (folder / each.folder / f"{each.name}.py").read_text()
        assert 'if __name__ == "__main__":' in source
        given = {*each.options, *(each.quick or ()), *(("--seed",) if each.seeded else ())}
        for option in given:
            assert not option.startswith("--") or f'"{option}"' in source, (each.name, option)


def test_studies_are_left_out_of_an_installed_wheel(tmp_path, monkeypatch):
    monkeypatch.setattr(suite, "find_spec", lambda _: None)
    start = Started(tmp_path)
    assert outcomes(tmp_path, start) == {
        "prints": "left out",
        "writes": "measured",
        "own": "measured",
    }
    (done, *_) = run_all(
        THREE, tmp_path, 0, quick=False, fresh=True, data=None, start=Started(tmp_path)
    )
    assert done.why == suite.WHY_NOT
