"""Files that appear whole or not at all, and files that others may have made."""

import os
import zipfile
from functools import cache, partial
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from eitskin import files
from eitskin.config import parse_toml, read_toml
from eitskin.datasets import Recipe, read_recording
from eitskin.datasets.store.manifest import read_manifest
from eitskin.errors import ConfigurationError, DataError, EitskinError, PartialError
from eitskin.geometry import SensorDesign
from eitskin.geometry.deformation.fixtures import Fixture
from eitskin.hardware import Script
from eitskin.simulator import Instrument, Mechanics, Protocol, Scene
from eitskin.training import StoredReference, TwinPrior


def test_files_and_folders_are_replaced_whole_or_not_at_all(tmp_path):
    path = tmp_path / "a.png"
    with files.atomic_file(path) as temporary:
        temporary.write_text("old")
        assert temporary.suffix == ".png"
        assert not path.exists()
    assert path.stat().st_mode & 0o777 == 0o644
    with pytest.raises(UnicodeEncodeError), files.atomic_file(path) as temporary:
        temporary.write_text("half \udcff", encoding="utf-8")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
    path = tmp_path / "above" / "some"
    filled(path, "a", "b")
    with pytest.raises(UnicodeEncodeError), files.atomic_folder(path) as folder:
        (folder / "c").write_text("half \udcff", encoding="utf-8")
    assert sorted(file.name for file in path.iterdir()) == ["a", "b"]
    filled(path, "c")
    assert [file.name for file in path.iterdir()] == ["c"]
    assert path.stat().st_mode & 0o777 == 0o755
    assert list(path.parent.iterdir()) == [path]


def filled(path, *names) -> None:
    with files.atomic_folder(path) as folder:
        for name in names:
            (folder / name).write_text(name)


@pytest.mark.parametrize(
    ("error", "raised"),
    [
        (PermissionError(13, "Permission denied"), ConfigurationError),
        (KeyboardInterrupt(), KeyboardInterrupt),
    ],
)
def test_a_folder_that_cannot_take_the_name_leaves_what_was_there(
    error, raised, tmp_path, monkeypatch
) -> None:
    path = tmp_path / "some"
    filled(path, "a")
    rename = type(path).rename

    def refuse(source, target):
        if source.name.startswith(".some.") and target == path:
            raise error
        return rename(source, target)

    monkeypatch.setattr(type(path), "rename", refuse)
    with pytest.raises(raised, match=r"^$|Permission denied"):
        filled(path, "b")
    assert [file.name for file in path.iterdir()] == ["a"]
    assert list(tmp_path.iterdir()) == [path]


def test_leftovers_are_removed_and_what_cannot_be_is_a_clear_error(tmp_path):
    files.write_file(tmp_path / "a.json", b"{}")
    (tmp_path / f"{files.TEMPORARY}x.json").write_text("half")
    files.remove_leftovers(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]
    with (
        pytest.raises(ConfigurationError, match="No such file or directory"),
        files.atomic_file(tmp_path / "none" / "a.txt"),
    ):
        pass
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ConfigurationError, match="pipe"), files.atomic_file(tmp_path / "pipe"):
        pass
    files.remove_file(tmp_path / "absent")
    (tmp_path / "folder").mkdir()
    with pytest.raises(PartialError, match=r"folder: .*--resume"):
        files.remove_file(tmp_path / "folder")


# Files that others may have made


def test_only_regular_files_of_bounded_size_are_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate(1 << 40)
    wrong = {
        tmp_path / "pipe": "pipe",
        "/dev/zero": "device",
        tmp_path: "folder",
        tmp_path / "sparse": "at most",
        tmp_path / "none": "No such file",
        "a\0b": "null",
    }
    for path, reason in wrong.items():
        with pytest.raises(DataError, match=reason):
            files.read_bytes(path, failure=DataError)


SCENES = "name = 'a'\n[[scenes]]\nstate = 'idle'\ncount = {}\n"
HUGE = (
    *((SensorDesign, "a = " + text) for text in ("[" * 200_000, "9" * 5000)),
    (SensorDesign, "'" + "k" * 100_000 + "' = 1"),
    (Recipe, SCENES.format(10**12)),
    (Recipe, f"frames_per_shard = {10**12}\n{SCENES.format(4)}"),
    (Recipe, f"{SCENES.format(4)}[specimens]\ncount = {10**12}\n"),
)


def test_what_python_cannot_hold_is_refused_and_values_are_quoted_briefly():
    for kind, text in HUGE:
        with pytest.raises(ConfigurationError) as refused:
            parse_toml(kind, text)
        assert len(str(refused.value)) < 1000
    for content in (b"[" * 200_000, b"9" * 5000, b'{"a": "\xff"}', b"1e999", b"NaN"):
        with pytest.raises(ValueError, match="JSON"):
            files.parse_json(content)
    assert files.quote_value("a\x1b") == r"'a\x1b'"
    assert len(files.quote_value("x" * 10**6)) < 150
    assert files.printable("a\tb\x9b\nc\u202e") == "a\\tb\\x9b\nc\\u202e"
    long = f"expected {'x' * 9000} at the end"
    assert files.printable(long) == str(DataError(long)) == f"{long[:2000]} ... {long[-2000:]}"


# Files from strangers, edited at random: read, or one clear error


CORPUS = Path(__file__).parents[1] / "data" / "hostile.zip"
PARSERS = {  # by kind: the file's name, and what reads it
    "TOML: designs": ("input.toml", SensorDesign.from_toml),
    "TOML: scenes": ("input.toml", Scene.from_toml),
    "TOML: recipes": ("input.toml", Recipe.from_toml),
    "TOML: fixtures": ("input.toml", partial(read_toml, Fixture)),
    "TOML: mechanics": ("input.toml", partial(read_toml, Mechanics)),
    "TOML: instruments": ("input.toml", partial(read_toml, Instrument)),
    "TOML: priors of twins": ("input.toml", partial(read_toml, TwinPrior)),
    "TOML: scripts of scenes": ("input.toml", Script.from_toml),
    "protocols (CSV)": ("input.csv", lambda path: Protocol.from_file(path, 8)),
    "manifests (JSON)": ("manifest.json", lambda path: read_manifest(path.parent)),
    "stored references (JSON)": ("input.json", StoredReference.read),
    "recordings: csv": ("input.csv", read_recording),
    "recordings: txt": ("input.txt", read_recording),
}
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


def is_read(kind, content, folder):
    """Whether an input is read; whatever but an EitskinError is raised."""
    name, read = PARSERS[kind]
    (folder / name).write_bytes(content)
    try:
        read(folder / name)
    except EitskinError:
        return False
    return True


@pytest.mark.slow
def test_inputs_that_reached_more_of_a_parser_are_read_or_refused(folder):
    for kind in PARSERS:
        read = [is_read(kind, content, folder) for content in corpus()[kind]]
        assert any(read), kind
        assert not all(read), kind


@pytest.mark.slow
@settings(
    max_examples=100,
    derandomize=True,
    database=None,
    suppress_health_check=list(HealthCheck),
)
@given(st.sampled_from(list(PARSERS)), st.data())
def test_edited_inputs_are_read_or_refused(folder, kind, data):
    content = data.draw(st.sampled_from(corpus()[kind]))
    for place, length, piece in data.draw(EDITS):
        at = int(place * len(content))
        content = content[:at] + piece + content[at + length :]
    is_read(kind, content, folder)
