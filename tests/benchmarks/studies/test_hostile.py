"""Hostile inputs of every kind, a few of each: read, or one clear error."""

import random
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from eitskin.benchmarks.studies.hostile import guided
from eitskin.benchmarks.studies.hostile.kinds import KINDS, draws, trial
from eitskin.benchmarks.studies.hostile.mutations import EXTREMES, TOKENS, damaged, misworded
from eitskin.benchmarks.studies.hostile.parsers import PARSERS
from eitskin.benchmarks.studies.hostile.run import tasks
from eitskin.benchmarks.studies.hostile.watched import OUTCOMES, outcome, watched
from eitskin.errors import EitskinError

CORPUS = Path(__file__).parents[2] / "data" / "hostile.zip"
QUICK = [kind for kind in PARSERS if kind != "saved pipelines: pipeline.json"]
PIECES = [*TOKENS, *(each.encode() for each in EXTREMES if len(each) < 500)]
EDITS = st.lists(
    st.tuples(st.floats(0, 1), st.integers(0, 40), st.binary(max_size=8) | st.sampled_from(PIECES)),
    min_size=1,
    max_size=4,
)
CHEAP = ("TOML", "manifests", "protocols", "stored", "tables", "bytes", "messages", "lines")


@pytest.mark.slow
def test_every_cheap_kind_is_read_or_refused_in_a_sentence(tmp_path, monkeypatch):
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path))
    for kind in KINDS:
        if kind.startswith(CHEAP):
            for number in range(8):
                found, message = outcome(trial(kind), draws(7, kind, number), tmp_path)
                assert found in OUTCOMES[:2], (kind, number, message)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder for the files of this module."""
    return tmp_path_factory.mktemp("hostile")


def parsed(kind, content, folder):
    """Read an input; whatever but an EitskinError is raised."""
    with suppress(EitskinError):
        PARSERS[kind].parse(content, folder)


@pytest.mark.slow
def test_good_inputs_are_read_and_those_that_reached_more_of_a_parser_do_no_harm(folder):
    corpus = guided.kept(CORPUS)
    assert set(corpus) == set(PARSERS)
    for kind in QUICK:
        for content in PARSERS[kind].good():
            PARSERS[kind].parse(content, folder)
        for content in corpus[kind]:
            parsed(kind, content, folder)


def test_a_corpus_keeps_the_smallest_inputs_that_reach_more(tmp_path):
    kind, found = "TOML: fixtures", tmp_path / "found"
    found.mkdir()
    for number, content in enumerate((b"a = [", b"b = [[", b"x" * 9000, *PARSERS[kind].good())):
        (found / str(number)).write_bytes(content)
    least = guided.least(kind, found, tmp_path)
    assert least[0] == b"a = ["
    assert b"b = [[" not in least
    assert PARSERS[kind].good()[0] in least
    guided.keep(kind, tmp_path / "corpus.zip", least)
    guided.keep("another", tmp_path / "corpus.zip", [b"1"])
    assert guided.kept(tmp_path / "corpus.zip") == {kind: least, "another": [b"1"]}


@pytest.mark.slow
@settings(
    max_examples=100,
    derandomize=True,
    deadline=None,
    database=None,
    suppress_health_check=list(HealthCheck),
)
@given(st.sampled_from(QUICK), st.data())
def test_edited_inputs_are_read_or_refused(folder, kind, data):
    content = data.draw(st.sampled_from(guided.seeds(kind, CORPUS)))
    for place, length, piece in data.draw(EDITS):
        at = int(place * len(content))
        content = content[:at] + piece + content[at + length :]
    parsed(kind, content, folder)


@pytest.mark.slow
def test_kinds_are_tried_in_a_process_that_is_watched():
    found = list(watched(7, tasks(2, "recordings: csv; surfaces"), workers=2))
    assert len({each[:2] for each in found}) == 5
    assert not [each for each in found if each[2] not in OUTCOMES[:2]]


def test_what_is_looked_for_is_told(tmp_path):
    def told(made):
        return outcome(made, draws(0, "a", 0), tmp_path)[0]

    def fail(error):
        def made(*_):
            raise error

        return made

    assert told(lambda *_: None) == "read"
    assert told(fail(EitskinError("x"))) == "one clear error"
    assert told(fail(KeyError("x"))) == "traceback"
    assert told(fail(MemoryError())) == "over 500 MB"


def test_inputs_are_the_same_again():
    text = "a = 1\nb = 2.5e-3\nc = [3, 4]"
    made = [[misworded(random.Random(n), text) for n in range(50)] for _ in range(2)]
    assert made[0] == made[1]
    assert any(extreme in each for each in made[0] for extreme in EXTREMES[:9])
    assert len({damaged(random.Random(n), b"0123456789" * 9) for n in range(50)}) > 40
