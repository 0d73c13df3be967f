"""Dataclasses from TOML and back: unions, complex numbers, paths, and what is refused."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from eitskin import config
from eitskin.errors import ConfigurationError


@dataclass(frozen=True, slots=True)
class Ball:
    radius: float


@dataclass(frozen=True, slots=True)
class Box:
    length: float
    width: float = 1.0


@dataclass(frozen=True, slots=True)
class Plain:
    pass


@dataclass(frozen=True, slots=True)
class Spaced:
    gap: float = 1.0


@dataclass(frozen=True, slots=True)
class Standing:
    base: Plain | Spaced | Box = field(default_factory=Plain)


@dataclass(frozen=True, slots=True)
class Thing:
    shape: Ball | Box
    z: complex = 0.0
    parts: tuple[Ball, ...] = ()
    spare: Ball | None = None
    file: Path | None = None
    size: float | None = None
    numbers: tuple[float, ...] = field(default=())
    side: Literal["left", "right"] = "left"


def thing(text):
    return config.parse_toml(Thing, text, "thing.toml", Path("folder"))


def test_a_union_is_the_member_whose_keys_are_there():
    assert thing("shape = { radius = 2 }").shape == Ball(2.0)
    assert thing("shape = { length = 2 }").shape == Box(2.0)
    assert thing("shape = { width = 3, length = 2 }").shape == Box(2.0, 3.0)


@pytest.mark.parametrize(
    ("text", "base", "written"),
    [
        ("", Plain(), 'base = "plain"\n'),
        ("base = 'plain'", Plain(), 'base = "plain"\n'),
        ("base = 'spaced'", Spaced(), "\n[base]\ngap = 1.0\n"),
        ("base = { gap = 2 }", Spaced(2.0), "\n[base]\ngap = 2.0\n"),
    ],
)
def test_a_member_that_needs_no_key_is_known_by_its_name(text, base, written):
    found = config.parse_toml(Standing, text)
    assert found == Standing(base)
    assert config.to_toml(found) == written
    assert config.parse_toml(Standing, written) == found


@pytest.mark.parametrize("text", ["'plan'", "'box'", "{ gap = 2, width = 1 }", "3"])
def test_a_name_that_no_member_has_is_refused(text):
    with pytest.raises(ConfigurationError, match=r"base: .*Spaced \(\[gap\]\) or Box \(length"):
        config.parse_toml(Standing, f"base = {text}")


BALL = "shape = { radius = 1 }\n"
WRONG = {
    "shape: .*did you mean 'radius'": ["shape = { radus = 2 }"],
    r"shape: .*Ball \(radius\) or Box": [
        *("shape = { radius = 2, width = 1 }", "shape = {}", "shape = 'ball'")
    ],
    r"shape\.radius: ": ["shape = { radius = 'big' }", "shape = { radius = nan }"],
    r"parts\[1\]: unknown": [f"{BALL}parts = [{{ radius = 1 }}, {{ radus = 1 }}]"],
    r"parts\[0\]: missing .*`radius`": [f"{BALL}parts = [{{ }}]"],
    r"parts: .*`dict`.*\[\[parts\]\]": [f"{BALL}parts = {{ radius = 1 }}"],
    "parts: .*`array`, got `int`$": [f"{BALL}parts = 3"],
    r"spare: .*table \(radius\), got `int`": [f"{BALL}spare = 3"],
    "`shape`": ["z = 1"],
    r"numbers\[1\]:.*finite .*-inf": [f"{BALL}numbers = [1, -inf]"],
    "z: ": [f"{BALL}z = {value}" for value in ("[1, nan]", "[1, 2, 3]", "'1+2j'")],
    "file: Expected `str`": [f"{BALL}file = 3"],
    r"side:.*'left'.*'right', got ": [f"{BALL}side = {value}" for value in ("'up'", "[1]")],
}


@pytest.mark.parametrize("message", WRONG)
def test_what_does_not_fit_is_named_with_its_place(message):
    for text in WRONG[message]:
        with pytest.raises(ConfigurationError, match=message):
            thing(text)


@pytest.mark.parametrize(
    ("z", "written"),
    [(0.5, "0.5"), (0.5 + 0j, "0.5"), (1 - 2e-3j, "[1.0, -0.002]"), (2j, "[0.0, 2.0]")],
)
def test_complex_numbers_are_a_number_or_a_pair(z, written):
    text = config.to_toml(Thing(Ball(1.0), z=z))
    assert f"\nz = {written}\n" in f"\n{text}"
    assert thing(text).z == z


def test_numbers_of_toml_have_64_bits_and_those_of_numpy_are_plain():
    given = Thing(Ball(np.float64(0.1)), z=np.complex128(1 + 2j), numbers=(np.float32(0.5),))
    assert config.to_dict(given) == {
        "shape": {"radius": 0.1},
        "z": [1.0, 2.0],
        "parts": [],
        "numbers": [0.5],
        "side": "left",
    }
    assert thing(config.to_toml(given)) == given
    nulls = {"shape": {"radius": 1.0}, "spare": None, "size": None}
    assert config.from_dict(Thing, nulls, "data") == Thing(Ball(1.0))
    assert config.toml_table(f"a = [{{ b = {2**63 - 1} }}]", "it")["a"][0]["b"] == 2**63 - 1
    for text in (f"a = {2**63}", f"a = [1, {{ b = {-(2**63) - 1} }}]", f"a = {'9' * 4000}"):
        with pytest.raises(
            ConfigurationError, match=r"^it is not valid TOML: integers have 64 bit"
        ):
            config.toml_table(text, "it")


def test_files_are_written_whole_with_paths_from_their_folder(tmp_path):
    text = "\ufefffile = 'part.stl'\nshape = { radius = 1 }"  # with a byte order mark
    (tmp_path / "thing.toml").write_text(text, encoding="utf-8")
    assert config.read_toml(Thing, tmp_path / "thing.toml").file == tmp_path / "part.stl"
    assert thing("file = 'part.stl'\nshape = { radius = 1 }").file == Path("folder/part.stl")
    assert thing("file = '/part.stl'\nshape = { radius = 1 }").file == Path("/part.stl")
    with pytest.raises(ConfigurationError, match="TOML text: file"):  # which is no user's file
        config.parse_toml(Thing, "file = '/etc/hosts'\nshape = { radius = 1 }")
    path = tmp_path / "thing.toml"
    text = config.write_toml(Thing(Ball(1.0)), path)
    assert path.read_text() == text == config.to_toml(Thing(Ball(1.0)))
    path.unlink()
    path.mkdir()
    with pytest.raises(ConfigurationError, match=r"thing\.toml"):
        config.write_toml(Thing(Ball(2.0)), path)
    assert list(tmp_path.iterdir()) == [path]
