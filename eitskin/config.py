"""Frozen dataclasses from TOML, strictly, and back.

The types of a dataclass say what its file may hold: other dataclasses are tables, a union of
dataclasses is the one whose keys are there, `complex` is a number or [real, imaginary], `Path` is
relative to the file. Everything else is checked by msgspec. Keys that nothing takes are errors
that name the nearest one that is known; numbers must be finite.
"""

import dataclasses
import difflib
import inspect
import itertools
import json
import math
import numbers
import tomllib
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard, TypeVar

import msgspec

from eitskin.errors import ConfigurationError
from eitskin.files import atomic_file

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Place:
    """Where plain data stands: for messages, and for paths that are relative to their file.

    Attributes:
        source: name of the file, or of whatever else the data is from.
        folder: that relative paths start from; None where no files may be named, because the data
            is not from a file of the user's.
        key: dotted keys down to the data; empty at the top.
    """

    source: str
    folder: Path | None = None
    key: str = ""

    def under(self, key: str) -> "Place":
        """The place of the value of `key`."""
        return dataclasses.replace(self, key=f"{self.key}.{key}" if self.key else key)

    def item(self, number: int) -> "Place":
        """The place of item `number` of a list."""
        return dataclasses.replace(self, key=f"{self.key}[{number}]")

    def error(self, message: object) -> ConfigurationError:
        """An error that names this place."""
        where = f"{self.source}: {self.key}" if self.key else self.source
        return ConfigurationError(f"{where}: {message}")


def read_toml(kind: type[T], path: str | Path) -> T:
    """Read the TOML file at `path` into the dataclass `kind`.

    Raises ConfigurationError where the file is missing, is not TOML, or does not fit.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"cannot read {path}: {error}") from error
    return parse_toml(kind, text, str(path), path.parent)


def parse_toml(kind: type[T], text: str, where: str = "TOML text", folder: Path | None = None) -> T:
    """Read TOML text into the dataclass `kind`.

    Args:
        kind: the dataclass.
        text: TOML.
        where: names the source in messages.
        folder: that relative paths start from; without it the text may name no files.
    """
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(f"{where} is not valid TOML: {error}") from error
    return from_dict(kind, data, where, folder)


def from_dict(kind: type[T], data: Mapping[str, Any], where: str, folder: Path | None = None) -> T:
    """Build `kind`, a dataclass or a union of them, from plain `data`, checked like TOML."""
    made: T = read(kind, data, Place(where, folder))
    return made


def build(make: Callable[..., T], data: Any, place: Place) -> T:
    """Call `make`, a dataclass or a function, with the keyword arguments that `data` holds.

    A dataclass may have a classmethod `spelled_out(data, place)` that returns the data with
    abbreviations written out; what it builds itself it puts in place of the plain data.

    Raises ConfigurationError for keys that are unknown or missing, values of another type, and
    everything that `make` refuses.
    """
    if not isinstance(data, Mapping):
        raise place.error(f"expected a table ({_keys(make)}), got `{type(data).__name__}`")
    spelled_out = getattr(make, "spelled_out", None)
    if spelled_out is not None:
        data = spelled_out(data, place)
    known = _parameters(make)
    for key in data:
        if key not in known:
            hint = _nearest(key, known) or f"; known: {', '.join(known)}"
            raise place.error(f"unknown key '{key}'{hint}")
    arguments = {
        key: read(known[key].annotation, value, place.under(key)) for key, value in data.items()
    }
    for name in _required(make):
        if name not in data:
            raise place.error(f"missing required field `{name}`")
    try:
        return make(**arguments)
    except ValueError as error:
        raise place.error(error) from error


def choose(makers: Iterable[Callable[..., T]], data: Any, place: Place) -> Callable[..., T]:
    """The first of `makers` that takes every key of `data` and needs none beyond them."""
    makers = tuple(makers)
    listed = " or ".join(f"{_name(make)} ({_keys(make)})" for make in makers)
    if not isinstance(data, Mapping):
        raise place.error(f"expected a table, {listed}, got `{type(data).__name__}`")
    for make in makers:
        if set(_required(make)) <= data.keys() <= _parameters(make).keys():
            return make
    known = list(itertools.chain.from_iterable(_parameters(make) for make in makers))
    hints = "".join(_nearest(key, known) for key in data if key not in known)
    given = ", ".join(data) if data else "no keys"
    raise place.error(f"expected the keys of one of {listed}, got {given}{hints}")


def read(kind: Any, data: Any, place: Place) -> Any:
    """What the type `kind` says, from plain `data`; what is built already is passed on."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return _read_union(kind, data, place)
    if origin in (tuple, list) and arguments[1:] in ((), (...,)):
        if not isinstance(data, list | tuple):
            hint = f"; tables of a list are headed [[{place.key}]]" * isinstance(data, Mapping)
            raise place.error(f"Expected `array`, got `{type(data).__name__}`{hint}")
        return origin(read(arguments[0], item, place.item(i)) for i, item in enumerate(data))
    if _is_dataclass(kind):
        return data if isinstance(data, kind) else build(kind, data, place)
    if kind is complex:
        return _complex(data, place)
    if kind is Path:
        return _path(data, place)
    return _plain(kind, data, place)


def _read_union(kind: Any, data: Any, place: Place) -> Any:
    members = tuple(member for member in typing.get_args(kind) if member is not types.NoneType)
    if data is None and types.NoneType in typing.get_args(kind):
        return None
    if len(members) == 1:
        return read(members[0], data, place)
    if all(map(_is_dataclass, members)):
        known = isinstance(data, members)
        return data if known else build(choose(members, data, place), data, place)
    return _plain(kind, data, place)


def _is_dataclass(kind: Any) -> TypeGuard[type]:
    return isinstance(kind, type) and dataclasses.is_dataclass(kind)


def _plain(kind: Any, data: Any, place: Place) -> Any:
    """A value that msgspec checks; numbers in it must be finite."""
    if typing.get_origin(kind) is typing.Literal and data not in typing.get_args(kind):
        known = " or ".join(f"'{choice}'" for choice in typing.get_args(kind))
        raise place.error(f"expected {known}, got {data!r}")
    try:
        value = msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        raise place.error(error) from error
    for number in value if isinstance(value, tuple | list) else (value,):
        if isinstance(number, float) and not math.isfinite(number):
            raise place.error(f"expected a finite number, got {number}")
    return value


def _complex(data: Any, place: Place) -> Any:
    if isinstance(data, list):
        return complex(*_plain(tuple[float, float], data, place))
    return _plain(float, data, place)


def _path(data: Any, place: Place) -> Path:
    if place.folder is None:
        raise place.error("names a file, which is possible only in a TOML file of its own")
    return place.folder / str(_plain(str, data, place))


def _parameters(make: Callable[..., Any]) -> Mapping[str, inspect.Parameter]:
    return inspect.signature(make, eval_str=True).parameters


def _required(make: Callable[..., Any]) -> list[str]:
    parameters = _parameters(make).items()
    return [name for name, parameter in parameters if parameter.default is parameter.empty]


def _keys(make: Callable[..., Any]) -> str:
    """The keys that `make` takes, for people; those that it can do without in brackets."""
    required = _required(make)
    return ", ".join(name if name in required else f"[{name}]" for name in _parameters(make))


def _name(make: Any) -> str:
    return str(getattr(make, "func", make).__name__)


def _nearest(key: str, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(key, known, n=1)
    return f"; did you mean '{near[0]}'?" if near else ""


def to_dict(value: Any) -> Any:
    """A dataclass as plain data, as TOML and JSON take it; fields that are None are left out."""
    if dataclasses.is_dataclass(value):
        items = ((field.name, getattr(value, field.name)) for field in dataclasses.fields(value))
        return {name: to_dict(item) for name, item in items if item is not None}
    if isinstance(value, tuple | list):
        return [to_dict(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, bool | str):
        return value
    if isinstance(value, numbers.Integral):
        return int(value)
    return float(value.real) if value.imag == 0 else [float(value.real), float(value.imag)]


def to_toml(value: object) -> str:
    """Write a dataclass as TOML: plain values first, then one table per dataclass within it.

    Equal dataclasses give equal text. Fields that are None are left out.
    """
    plain, tables = [], []
    for name, item in to_dict(value).items():
        if isinstance(item, dict):
            tables += ["", f"[{name}]", *_lines(item)]
        elif isinstance(item, list) and item and isinstance(item[0], dict):
            for row in item:
                tables += ["", f"[[{name}]]", *_lines(row)]
        else:
            plain.append(f"{name} = {_inline(item)}")
    return "\n".join(plain + tables) + "\n"


def write_toml(value: object, path: str | Path) -> str:
    """Write a dataclass to the TOML file `path`, whole or not at all, and return the text.

    Raises ConfigurationError where the file cannot be written.
    """
    text = to_toml(value)
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return text


def _lines(table: Mapping[str, Any]) -> list[str]:
    return [f"{name} = {_inline(item)}" for name, item in table.items()]


def _inline(value: object) -> str:
    """One value; JSON's strings are TOML's too, but for DEL, which TOML wants escaped."""
    if isinstance(value, dict):
        return "{ " + ", ".join(_lines(value)) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(_inline(item) for item in value) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)
