"""Files from strangers, edited at random: read, or one clear error."""

import zipfile
from contextlib import suppress
from functools import cache
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from eitskin.errors import EitskinError

from parsers import PARSERS

CORPUS = Path(__file__).parents[1] / "data" / "hostile.zip"
QUICK = [kind for kind in PARSERS if kind != "saved pipelines: pipeline.json"]
BYTES = (b"\0", b"\xff\xfe", b"\xef\xbb\xbf", b"\r", b"\n\n", b'"', b",", b";", b"\t", b"{", b"]")
WORDS = (b"nan", b"-inf", b"1e999", b"-0", b"%n%s", b"../../etc/passwd", b"/dev/zero", b"\x1b[2J")
NUMBERS = (b"1e308", b"5e-324", b"9" * 400, b"true", b"null", b'"\\u0000"', b"[]", b"1979-05-27")
EDITS = st.lists(
    st.tuples(
        st.floats(0, 1),
        st.integers(0, 40),
        st.binary(max_size=8) | st.sampled_from((*BYTES, *WORDS, *NUMBERS)),
    ),
    min_size=1,
    max_size=4,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder for the files of this module."""
    return tmp_path_factory.mktemp("hostile")


@cache
def corpus():
    """Inputs that reached more of a parser than those before them, by kind."""
    inputs = {}
    with zipfile.ZipFile(CORPUS) as file:
        for name in file.namelist():
            inputs.setdefault(name.rpartition("/")[0], []).append(file.read(name))
    return inputs


def parsed(kind, content, folder):
    """Read an input; whatever but an EitskinError is raised."""
    with suppress(EitskinError):
        PARSERS[kind].parse(content, folder)


@pytest.mark.slow
def test_good_inputs_are_read_and_those_that_reached_more_of_a_parser_do_no_harm(folder):
    assert set(corpus()) == set(PARSERS)
    for kind in QUICK:
        for content in PARSERS[kind].good():
            PARSERS[kind].parse(content, folder)
        for content in corpus()[kind]:
            parsed(kind, content, folder)


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
    content = data.draw(st.sampled_from((*PARSERS[kind].good(), *corpus()[kind])))
    for place, length, piece in data.draw(EDITS):
        at = int(place * len(content))
        content = content[:at] + piece + content[at + length :]
    parsed(kind, content, folder)
