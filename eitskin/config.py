"""Checked configuration: frozen dataclasses from TOML and back.

The type annotations of a dataclass define its file: a nested dataclass is a table, `complex` is a
number or [real, imaginary], `Path` is relative to the file. A union of dataclasses is resolved by
its keys, or by the name, in lower case, of a member that needs none; a dataclass without fields is
written as its name. msgspec checks everything else. An unknown key is an error that names the
nearest known key; numbers must be finite.
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
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeGuard, TypeVar

import msgspec

from eitskin.errors import ConfigurationError
from eitskin.files import atomic_file, quote_value, read_text, shorten_text

MAX_TOML: Final = 16 << 20
"""Largest size of a TOML file [bytes]: a recipe with a table of 16,384 channels has 0.5 MB."""

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Location:
    """Location of plain data in its source, for error messages and relative paths.

    Attributes:
        source: name of the file or of another source.
        folder: start of relative paths; None for a source that may name no files.
        key: dotted keys from the top of the source to the data; empty at the top.
    """

    source: str
    folder: Path | None = None
    key: str = ""

    def child(self, key: str) -> "Location":
        """Location of the value of `key`."""
        return dataclasses.replace(self, key=f"{self.key}.{key}" if self.key else key)

    def item(self, number: int) -> "Location":
        """Location of item `number` of a list."""
        return dataclasses.replace(self, key=f"{self.key}[{number}]")

    def error(self, message: object) -> ConfigurationError:
        """ConfigurationError whose message starts with this location."""
        where = f"{self.source}: {self.key}" if self.key else self.source
        return ConfigurationError(f"{where}: {message}")


def read_toml(kind: type[T], path: str | Path) -> T:
    """Read the TOML file at `path` into the dataclass `kind`.

    Raises ConfigurationError where the file is missing, is not TOML, or does not fit.
    """
    path = Path(path)
    return parse_toml(kind, read_text(path, MAX_TOML), str(path), path.parent)


def parse_toml(kind: type[T], text: str, where: str = "TOML text", folder: Path | None = None) -> T:
    """Read TOML text into the dataclass `kind`; errors name `where` as the source.

    Without a `folder`, where relative paths start, the text may name no files. Raises
    ConfigurationError where the text is not TOML or does not fit.
    """
    return from_dict(kind, toml_table(text, where), where, folder)


def toml_table(text: str, where: str) -> dict[str, Any]:
    """Table of a TOML text; raises ConfigurationError, naming `where`, for text that is not TOML.

    Brackets nested beyond Python's calls and integers of more than 64 bits are not TOML either.
    """
    try:
        table = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(f"{where} is not valid TOML: {error}") from error
    for integer in _integers(table):
        if not -(2**63) <= integer < 2**63:
            raise ConfigurationError(
                f"{where} is not valid TOML: integers have 64 bits, got {quote_value(integer)}"
            )
    return table


def _integers(data: Any) -> Iterator[int]:
    """All integers within tables and lists."""
    pending = [data]
    while pending:
        each = pending.pop()
        if isinstance(each, int):
            yield each
        elif isinstance(each, dict):
            pending.extend(each.values())
        elif isinstance(each, list):
            pending.extend(each)


def from_dict(kind: type[T], data: Mapping[str, Any], where: str, folder: Path | None = None) -> T:
    """Build `kind`, a dataclass or a union of dataclasses, from plain `data`, checked like TOML."""
    value: T = read(kind, data, Location(where, folder))
    return value


def build(make: Callable[..., T], data: Any, location: Location) -> T:
    """Call `make`, a dataclass or a function, with the keyword arguments that `data` holds.

    A dataclass may have a classmethod `expanded(data, location)` that replaces abbreviations in
    the data by what they stand for, as plain data or as dataclasses.

    Raises ConfigurationError for unknown and missing keys, wrong types and ValueErrors of `make`.
    """
    if not isinstance(data, Mapping):
        raise location.error(f"expected a table ({_keys(make)}), got `{type(data).__name__}`")
    expanded = getattr(make, "expand_data", None)
    if expanded is not None:
        data = expanded(data, location)
    known = _parameters(make)
    for key in data:
        if key not in known:
            hint = _nearest(key, known) or f"; known: {', '.join(known)}"
            raise location.error(f"unknown key {quote_value(key)}{hint}")
    arguments = {
        key: read(known[key].annotation, value, location.child(key)) for key, value in data.items()
    }
    for name in _required_parameters(make):
        if name not in data:
            raise location.error(f"missing required field `{name}`")
    try:
        return make(**arguments)
    except ValueError as error:
        raise location.error(error) from error


def choose(makers: Iterable[Callable[..., T]], data: Any, location: Location) -> Callable[..., T]:
    """First of `makers` that accepts every key of `data` and requires no other key."""
    makers = tuple(makers)
    listed = _describe_members(makers)
    if not isinstance(data, Mapping):
        raise location.error(f"expected a table, {listed}, got `{type(data).__name__}`")
    for make in makers:
        if set(_required_parameters(make)) <= data.keys() <= _parameters(make).keys():
            return make
    parameters = list(itertools.chain.from_iterable(_parameters(make) for make in makers))
    hints = "".join(_nearest(key, parameters) for key in data if key not in parameters)
    key_text = shorten_text(", ".join(data)) if data else "no keys"
    raise location.error(f"expected the keys of one of {listed}, got {key_text}{hints}")


def read(kind: Any, data: Any, location: Location) -> Any:
    """Value of the type `kind` from plain `data`; a dataclass instance is returned unchanged."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return _read_union(kind, data, location)
    if origin in (tuple, list) and arguments[1:] in ((), (...,)):
        if not isinstance(data, list | tuple):
            hint = f"; tables of a list are headed [[{location.key}]]" * isinstance(data, Mapping)
            raise location.error(f"Expected `array`, got `{type(data).__name__}`{hint}")
        return origin(read(arguments[0], item, location.item(i)) for i, item in enumerate(data))
    if _is_dataclass(kind):
        return data if isinstance(data, kind) else build(kind, data, location)
    if kind is complex:
        return _complex(data, location)
    if kind is Path:
        return _path(data, location)
    return _plain(kind, data, location)


def _read_union(kind: Any, data: Any, location: Location) -> Any:
    members = tuple(member for member in typing.get_args(kind) if member is not types.NoneType)
    if data is None and types.NoneType in typing.get_args(kind):
        return None
    if len(members) == 1:
        return read(members[0], data, location)
    makers = tuple(filter(_is_dataclass, members))
    if makers and len(makers) < len(members) and not isinstance(data, (Mapping, *makers)):
        (plain,) = set(members) - set(makers)
        return read(plain, data, location)
    if members := makers:
        if isinstance(data, str) and _nameable(members):
            return _member_by_name(members, data, location)
        is_member = isinstance(data, members)
        return data if is_member else build(choose(members, data, location), data, location)
    return _plain(kind, data, location)


def _member_by_name(makers: tuple[Callable[..., T], ...], name: str, location: Location) -> T:
    """Member of a union by its name; raises ConfigurationError where no member has the name."""
    named = _nameable(makers)
    if name in named:
        return named[name]()
    names = " or ".join(f"'{each}'" for each in named)
    hint = _nearest(name, named)
    raise location.error(
        f"expected {names} or a table, {_describe_members(makers)}, got {quote_value(name)}{hint}"
    )


def _nameable(makers: Iterable[Callable[..., T]]) -> dict[str, Callable[..., T]]:
    """Members of a union that need no key, by their names in lower case."""
    return {_name(make).lower(): make for make in makers if not _required_parameters(make)}


def _describe_members(makers: Iterable[Callable[..., Any]]) -> str:
    """Names and keys of the members of a union, as text."""
    return " or ".join(f"{_name(make)} ({_keys(make)})" for make in makers if _parameters(make))


def _is_dataclass(kind: Any) -> TypeGuard[type]:
    return isinstance(kind, type) and dataclasses.is_dataclass(kind)


def _plain(kind: Any, data: Any, location: Location) -> Any:
    """Value checked by msgspec; its numbers must be finite."""
    if typing.get_origin(kind) is typing.Literal and data not in typing.get_args(kind):
        choices = " or ".join(f"'{choice}'" for choice in typing.get_args(kind))
        raise location.error(f"expected {choices}, got {quote_value(data)}")
    try:
        value = msgspec.convert(data, getattr(kind, "type", kind))  # of an InitVar
    except (msgspec.ValidationError, OverflowError) as error:  # integers beyond the largest float
        raise location.error(error) from error
    for number in value if isinstance(value, tuple | list) else (value,):
        if isinstance(number, float) and not math.isfinite(number):
            raise location.error(f"expected a finite number, got {number}")
    return value


def _complex(data: Any, location: Location) -> Any:
    if isinstance(data, list):
        return complex(*_plain(tuple[float, float], data, location))
    return _plain(float, data, location)


def _path(data: Any, location: Location) -> Path:
    if location.folder is None:
        raise location.error("names a file, which is possible only in a TOML file of its own")
    name = str(_plain(str, data, location))
    if "\0" in name:
        raise location.error(f"expected the name of a file, got {quote_value(name)}")
    return location.folder / name


def _parameters(make: Callable[..., Any]) -> Mapping[str, inspect.Parameter]:
    return inspect.signature(make, eval_str=True).parameters


def _required_parameters(make: Callable[..., Any]) -> list[str]:
    parameters = _parameters(make).items()
    return [name for name, parameter in parameters if parameter.default is parameter.empty]


def _keys(make: Callable[..., Any]) -> str:
    """Keys that `make` accepts, as text; optional ones in brackets."""
    required = _required_parameters(make)
    return ", ".join(name if name in required else f"[{name}]" for name in _parameters(make))


def _name(make: Any) -> str:
    return str(getattr(make, "func", make).__name__)


def _nearest(key: str, candidates: Iterable[str]) -> str:
    near = difflib.get_close_matches(key, candidates, n=1)
    return f"; did you mean '{near[0]}'?" if near else ""


def to_dict(value: Any) -> Any:
    """Convert a dataclass to plain data for TOML and JSON; fields that are None are left out.

    A dataclass without fields becomes its name in lower case, or the text of its `abbreviated()`.
    """
    if dataclasses.is_dataclass(value):
        abbreviated = getattr(value, "short_name", lambda: None)()
        items = ((field.name, getattr(value, field.name)) for field in dataclasses.fields(value))
        table = {name: to_dict(item) for name, item in items if item is not None}
        return abbreviated or (table if dataclasses.fields(value) else _name(type(value)).lower())
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
    """Convert a dataclass to TOML text: plain values first, then one table per nested dataclass.

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
    """Write a dataclass to the TOML file `path` atomically, and return the text.

    Raises ConfigurationError where the file cannot be written.
    """
    text = to_toml(value)
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return text


def _lines(table: Mapping[str, Any]) -> list[str]:
    return [f"{name} = {_inline(item)}" for name, item in table.items()]


def _inline(value: object) -> str:
    """Value on one line; JSON strings are TOML strings, except for DEL, which TOML escapes."""
    if isinstance(value, dict):
        return "{ " + ", ".join(_lines(value)) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(_inline(item) for item in value) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)
