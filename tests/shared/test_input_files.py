"""Files that somebody else made: what kind they are, how large, and what their text holds."""

import os

import pytest

from eitskin.config import parse_toml, read_toml
from eitskin.datasets import Recipe
from eitskin.errors import ConfigurationError, DataError
from eitskin.files import parse_json, printable, quoted, read_bytes, read_text
from eitskin.geometry import SensorDesign


def test_a_regular_file_is_read(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"\r\n\x1a")
    assert read_bytes(path) == b"\r\n\x1a"


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
            read_bytes(path, failure=DataError)


def test_bytes_that_are_no_text_are_refused(tmp_path):
    (tmp_path / "a").write_bytes(b"\xff")
    with pytest.raises(ConfigurationError, match="UTF-8"):
        read_text(tmp_path / "a")


def test_toml_that_python_cannot_hold_is_refused(tmp_path):
    for text in ("a = " + "[" * 200_000, "a = " + "9" * 5000, "'" + "k" * 100_000 + "' = 1"):
        with pytest.raises(ConfigurationError) as refused:
            parse_toml(SensorDesign, text)
        assert len(str(refused.value)) < 1000
    os.mkfifo(tmp_path / "design.toml")
    with pytest.raises(ConfigurationError, match="pipe"):
        read_toml(SensorDesign, tmp_path / "design.toml")


def test_counts_beyond_every_memory_are_refused():
    scenes = "[[scenes]]\nstate = 'idle'\ncount = {}\n"
    for text in (
        scenes.format(10**12),
        f"frames_per_shard = {10**12}\n{scenes.format(4)}",
        f"{scenes.format(4)}[specimens]\ncount = {10**12}\n",
    ):
        with pytest.raises(ConfigurationError, match="got 1000000000000"):
            parse_toml(Recipe, f"name = 'a'\n{text}")


def test_integers_beyond_every_float_are_refused():
    with pytest.raises(ConfigurationError):
        parse_toml(SensorDesign, f"thickness = 1{'0' * 400}")


def test_json_that_python_cannot_hold_is_refused():
    for content in (b"[" * 200_000, b"9" * 5000, b'{"a": "\xff"}', b"1e999", b"NaN"):
        with pytest.raises(ValueError, match="JSON"):
            parse_json(content)


def test_values_of_files_are_quoted_in_part():
    assert quoted("a\x1b") == r"'a\x1b'"
    assert len(quoted("x" * 10**6)) < 150
    assert printable("a\tb\x9b\nc\u202e") == "a\\tb\\x9b\nc\\u202e"
    long = f"expected {'x' * 9000} at the end"
    assert printable(long) == str(DataError(long)) == f"{long[:2000]} ... {long[-2000:]}"
