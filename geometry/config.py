"""Frozen dataclasses from TOML, strictly, and back.

Types are checked by msgspec; keys that no field takes are errors that name the nearest field.
"""

import dataclasses
import difflib
import json
import tomllib
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from eitskin.geometry.errors import ConfigurationError

T = TypeVar("T")


def read_toml(kind: type[T], path: str | Path) -> T:
    """Read the TOML file at `path` into the dataclass `kind`.

    Raises ConfigurationError where the file is missing, is not TOML, or does not fit.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"cannot read {path}: {error}") from error
    return parse_toml(kind, text, where=str(path))


def parse_toml(kind: type[T], text: str, where: str = "TOML text") -> T:
    """Read TOML text into the dataclass `kind`; `where` names the source in messages."""
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(f"{where} is not valid TOML: {error}") from error
    return from_dict(kind, data, where)


def from_dict(kind: type[T], data: Mapping[str, Any], where: str) -> T:
    """Build the dataclass `kind` from plain `data`; the same checks as `read_toml`."""
    _refuse_unknown_keys(kind, data, where)
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        raise ConfigurationError(f"{where}: {error}") from error


def _refuse_unknown_keys(kind: Any, data: Any, where: str) -> None:
    """Walk `data` beside the dataclass `kind` and refuse keys that it has no field for."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        for choice in arguments:
            if dataclasses.is_dataclass(choice) and isinstance(data, Mapping):
                _refuse_unknown_keys(choice, data, where)
    elif origin in (tuple, list) and isinstance(data, list):
        for i, item in enumerate(data):
            _refuse_unknown_keys(arguments[0], item, f"{where}[{i}]")
    elif dataclasses.is_dataclass(kind) and isinstance(data, Mapping):
        hints = typing.get_type_hints(kind)
        names = [field.name for field in dataclasses.fields(kind) if field.init]
        for key, value in data.items():
            if key not in names:
                near = difflib.get_close_matches(key, names, n=1)
                hint = f"; did you mean '{near[0]}'?" if near else f"; known: {', '.join(names)}"
                raise ConfigurationError(f"{where}: unknown key '{key}'{hint}")
            _refuse_unknown_keys(hints[key], value, f"{where}.{key}")


def to_toml(value: object) -> str:
    """Write a dataclass as TOML: plain values first, then one table per dataclass within it.

    Equal dataclasses give equal text. Fields that are None are left out.
    """
    plain, tables = [], []
    for name, item in _items(value):
        if dataclasses.is_dataclass(item):
            tables += ["", f"[{name}]", *_lines(item)]
        elif isinstance(item, tuple) and item and dataclasses.is_dataclass(item[0]):
            for row in item:
                tables += ["", f"[[{name}]]", *_lines(row)]
        else:
            plain.append(f"{name} = {_inline(item)}")
    return "\n".join(plain + tables) + "\n"


def _items(value: Any) -> list[tuple[str, Any]]:
    fields = [(field.name, getattr(value, field.name)) for field in dataclasses.fields(value)]
    return [(name, item) for name, item in fields if item is not None]


def _lines(value: object) -> list[str]:
    return [f"{name} = {_inline(item)}" for name, item in _items(value)]


def _inline(value: object) -> str:
    """One value; JSON's strings are TOML's too, but for DEL, which TOML wants escaped."""
    if dataclasses.is_dataclass(value):
        return "{ " + ", ".join(_lines(value)) + " }"
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_inline(item) for item in value) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)
