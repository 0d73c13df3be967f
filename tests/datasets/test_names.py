"""Names of specimens and sessions, from a recording through datasets made of it."""

import dataclasses

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from eitskin.cli.commands.import_recording import command
from eitskin.datasets import combine, open_dataset, save_dataset
from eitskin.datasets.store.manifest import Names
from eitskin.datasets.store.rewriting import compact
from eitskin.datasets.store.summary import specimens_in_words

from small_dataset import make

ROWS = """specimen,sensor,session,x,y,v0,v1,v2
gel B,left,monday,0.01,0.02,1.0,2.0,3.0
gel A,left,monday,0.01,0.02,1.1,2.0,3.0
gel B,left,tuesday,0.01,0.02,1.2,2.0,3.0
gel A,right,tuesday,0.01,0.02,1.3,2.0,3.0
"""
SPECIMENS = {0: "gel B left", 1: "gel A left", 2: "gel A right"}
SESSIONS = {0: "monday", 1: "tuesday"}


def run(app_, *arguments):
    done = CliRunner().invoke(app_, [str(each) for each in arguments])
    assert done.exit_code == 0, done.output
    return done.output


@pytest.fixture
def named(tmp_path):
    (tmp_path / "mine.csv").write_text(ROWS)
    importing = typer.Typer()
    importing.command()(command)
    run(importing, tmp_path / "mine.csv", "--out", tmp_path / "mine", "--protocol", "pairwise:3")
    return tmp_path / "mine"


def test_names_of_an_import_stay_with_the_dataset(named):
    data = open_dataset(named)
    assert data.names == Names(SPECIMENS, SESSIONS)
    assert data.specimen_names == tuple(SPECIMENS.values())
    assert data.select([1, 3]).specimen_names == ("gel A left", "gel A right")
    assert specimens_in_words(data.select([3])) == "1 specimen (gel A right)"


def test_compacting_keeps_them(named, tmp_path):
    compact(named, tmp_path / "compact")
    assert open_dataset(tmp_path / "compact").names == Names(SPECIMENS, SESSIONS)


def test_combined_sets_keep_them_with_their_new_numbers(named, tmp_path):
    data = dataclasses.replace(open_dataset(named), names=Names(), impedance=np.ones((4, 3)))
    save_dataset(data, tmp_path / "yours")
    combine([tmp_path / "yours", named], tmp_path / "both")
    both = open_dataset(tmp_path / "both")
    unnamed = ("yours 0", "yours 1", "yours 2")
    assert both.specimen_names == (*unnamed, *SPECIMENS.values())
    assert both.names.sessions == {2: "monday", 3: "tuesday"}
    assert both.select(both.specimen == 4).specimen_names == ("gel A left",)


def test_simulated_specimens_have_numbers_alone(tmp_path):
    save_dataset(make(12, specimens=3), tmp_path / "simulated")
    assert b"names" not in (tmp_path / "simulated" / "manifest.json").read_bytes()
    data = open_dataset(tmp_path / "simulated")
    assert not data.names
    assert data.specimen_names == ("0", "1", "2")
    assert specimens_in_words(data) == "3 specimens"


def test_many_names_are_told_by_the_first_few():
    data = dataclasses.replace(make(40, specimens=20), names=Names({3: "mine"}))
    told = specimens_in_words(data)
    assert told == "20 specimens (0, 1, 2, mine, 4, 5, 6, 7 and 12 more)"
