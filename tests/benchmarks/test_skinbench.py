"""skinbench: frozen recipes, scores from figures, and a leaderboard that only results fill."""

import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from command_line import run

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
from eitskin.benchmarks.paper import sets as paper_sets
from eitskin.benchmarks.result_pages import PUBLISHED_FOLDER
from eitskin.benchmarks.results import Report, ReportTable, Results, read_results
from eitskin.benchmarks.transfer import WORLDS
from eitskin.datasets import Recipe
from eitskin.errors import ConfigurationError, DataError
from eitskin.provenance import Provenance

ROOT = Path(__file__).parents[2]
FROZEN = ROOT / "benchmarks" / "skinbench" / "recipes"
TRACK = {track.results: track for track in TRACKS}


def results(figures, name="recordings", **changes):
    made = Results(name, f"eitskin bench {name}", Provenance.now(0), 1.0, False, figures)
    return replace(made, **changes)


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
    for track, made in made_today().items():
        kept = {path.stem: Recipe.from_toml(path) for path in (FROZEN / track).iterdir()}
        today = {re.sub("[ ,]+", "-", name): recipe for name, recipe in made.items()}
        assert set(kept) == set(today), track
        for name, recipe in kept.items():
            assert recipe == today[name], f"{track}/{name}: other frames need another VERSION"


def test_figures_become_scores_in_their_units_and_the_worst_of_all_worlds():
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


def test_a_run_again_replaces_its_entries_and_the_best_come_first():
    first = Leaderboard().with_results(results({"400 / maps": 3.0, "400 / ridge": 19.0}))
    other = first.with_results(results({"400 / maps": 4.0}, command="eitskin bench other"))
    again = other.with_results(results({"400 / maps": 2.0, "5 / few": 3.0}))
    assert [each.scores.get("400 presses") for each in again.entries] == [2.0, 4.0, 19.0, None]
    table = again.table(TRACK["recordings"]).splitlines()
    assert table[2].startswith("| maps | 2.00 |  |")
    assert all(line.count("|") == table[0].count("|") for line in table)


def test_a_file_is_read_as_it_was_written_and_others_are_refused(tmp_path):
    path = tmp_path / "board.json"
    board = Leaderboard().with_results(results({"50 / maps": 3.0}), "f00d", {"maps": "c0de"})
    write_leaderboard(path, board)
    assert read_leaderboard(path) == board
    assert (board.entries[0].frames, board.entries[0].code) == ("f00d", "c0de")
    document = json.loads(path.read_text())
    for wrong in (document | {"version": VERSION + 1}, {"entries": 3}, ["no"]):
        path.write_text(json.dumps(wrong))
        with pytest.raises(DataError):
            read_leaderboard(path)


def test_a_benchmark_enters_its_results_with_the_digests_of_frames_and_code(tmp_path, monkeypatch):
    start = "my:Net / {}, 0 angles / place, mean [mm]"
    found = results({start.format(world): 2.5 for world in WORLDS}, "transfer")
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


def test_the_file_is_that_of_the_published_results():
    board = read_leaderboard(ROOT / "docs" / "results" / "leaderboard.json")
    files = [PUBLISHED_FOLDER / track.results / "results.json" for track in TRACKS]
    for path in files:
        assert board.with_results(read_results(path)) == board
    published = {read_results(path).command for path in files}
    assert published <= {entry.command for entry in board.entries}
