"""Conversion of arguments where public names are called: taken, converted or refused by name.

Type annotations are the rules. A number may come from any library, a sequence may be any but text,
an array any of numbers; what a type cannot hold (an integer beyond floats, a masked or imaginary
value, text for a number) is a ConfigurationError that names the argument. Ranges are checked where
values are used.
"""

import enum
import functools
import inspect
import operator
import os
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import InitVar
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from eitskin.errors import ConfigurationError

Converter = Callable[[Any], Any]
"""Value that a function takes; raises TypeError, ValueError or OverflowError with the reason."""

MAX_NAME = 255  # bytes of one name in a path
MAX_TEXT = 100  # characters of a value in a message
MAX_BITS = 1000  # of an integer that a float holds
_FOREIGN = ("builtins", "numpy", "pandas", "torch", "decimal", "fractions", "pathlib")
_KINDS = {"f": "real numbers", "c": "numbers", "i": "whole numbers", "b": "truth values"}


def convert_arguments(public: Any) -> Any:
    """A public function, or class with its methods, whose arguments are converted.

    Classes are changed in place; a function gets one public form.
    """
    if inspect.isfunction(public):
        call = _converting(public)
        # Pickled by its public name; the function itself by that of its module.
        call.__module__ = ".".join(public.__module__.split(".")[:2])
        return call
    if not isinstance(public, type) or issubclass(public, BaseException | enum.Enum):
        return public
    for owner in public.__mro__:
        if owner.__module__.startswith("eitskin.") and not getattr(owner, "_is_protocol", False):
            for name, member in list(vars(owner).items()):
                if name != "__init__" and name.startswith("_"):
                    continue
                if isinstance(member, classmethod | staticmethod):
                    setattr(owner, name, type(member)(_converting(member.__func__)))
                elif inspect.isfunction(member):
                    setattr(owner, name, _converting(member))
    return public


def _converting(function: Callable[..., Any]) -> Callable[..., Any]:
    """Function that converts its arguments first; one that does already is returned."""
    if made := getattr(function, "_public", None):
        return made  # type: ignore[no-any-return]
    rules: dict[str, Converter] = {}
    names: list[str] = []

    @functools.wraps(function)
    def call(*given: Any, **named: Any) -> Any:
        if not names:
            rules.update(_rules(function))
            names.extend(rules)
        taken = [
            _convert(function, name, rules[name], value)
            for name, value in zip(names, given, strict=False)
        ]
        for name, value in named.items():
            if name in rules:
                named[name] = _convert(function, name, rules[name], value)
        return function(*taken, *given[len(taken) :], **named)

    function._public = call._public = call  # type: ignore[attr-defined]
    return call


def _convert(function: Callable[..., Any], name: str, rule: Converter, value: Any) -> Any:
    try:
        return rule(value)
    except Exception as error:  # foreign types raise anything when they are converted
        what = function.__qualname__.removesuffix(".__init__")
        raise ConfigurationError(
            f"{what}: {name}: {error}, got {_describe_value(value)}"
        ) from error


def _describe_value(value: Any) -> str:
    """Value for a message: its type and, where it is short, its content."""
    if isinstance(value, str | bytes | float | complex | None) or (
        isinstance(value, int) and value.bit_length() < MAX_BITS
    ):
        text = repr(value)
        return text if len(text) <= MAX_TEXT else f"{text[:MAX_TEXT]} ..."
    shape = getattr(value, "shape", None)
    return f"a value of type {type(value).__name__}" + (
        f" and shape {tuple(shape)}" if shape else ""
    )


def _rules(function: Callable[..., Any]) -> dict[str, Converter]:
    """Converters of the parameters of a function, in order; those of `*names` are none."""
    try:
        kinds = typing.get_type_hints(function)
    except NameError:  # imported for type checkers only
        kinds = {}
    rules: dict[str, Converter] = {}
    for name, parameter in inspect.signature(function).parameters.items():
        if parameter.kind is parameter.VAR_POSITIONAL:
            break
        if parameter.kind is not parameter.VAR_KEYWORD:
            rules[name] = converter(kinds.get(name, Any))
    return rules


def converter(kind: Any) -> Converter:
    """Converter to values of a type annotation."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if kind not in _PLAIN and hasattr(origin or kind, "__value__"):  # an alias by `type`
        alias = (origin or kind).__value__
        return converter(alias[inner] if inner else alias)
    rule: Converter = _identity
    if isinstance(kind, InitVar):
        rule = converter(kind.type)
    elif origin in (typing.Union, types.UnionType):
        rule = partial(_convert_union, tuple(_members(inner)))
    elif kind in _PLAIN:
        rule = _PLAIN[kind]
    elif origin is typing.Literal:
        rule = partial(_choice, inner)
    elif origin is np.ndarray:
        scalar = typing.get_args(inner[1])[0]
        rule = partial(_array, next((k for k, of in _LETTERS if _is_subtype(scalar, of)), "c"))
    elif origin is tuple and inner[1:] != (...,):
        rule = partial(_row, tuple(map(converter, inner)))
    elif origin in _SEQUENCES:
        rule = partial(_items, converter(inner[0]), origin)
    elif isinstance(kind, type) and issubclass(kind, enum.Enum):
        rule = partial(_member, kind)
    elif isinstance(origin or kind, type) and not getattr(origin or kind, "_is_protocol", False):
        rule = partial(_instance, origin or kind)
    return rule


def _members(inner: tuple[Any, ...]) -> Iterator[Converter]:
    """Converters of the members of a union, of which some stand for one."""
    left = list(inner)
    for kind, parts in ((ArrayLike, typing.get_args(ArrayLike)), (Path, (str, Path))):
        if parts and set(parts) <= set(left):
            named = kind is ArrayLike and left.index(str) < left.index(parts[0])  # str | ArrayLike
            left = [each for each in left if each not in parts] + [str] * named
            yield _PLAIN[kind]
    yield from map(converter, left)


def _is_subtype(scalar: Any, of: type) -> bool:
    return isinstance(scalar, type) and issubclass(scalar, of)


def _identity(value: Any) -> Any:
    return value


def _real(value: Any) -> Any:
    if isinstance(value, float) or (type(value) is int and value.bit_length() < MAX_BITS):
        return value
    if isinstance(value, str | bytes | bool | np.bool_ | np.ma.MaskedArray) or np.iscomplexobj(
        value
    ):
        raise TypeError("expected a real number")
    try:
        return float(value)
    except OverflowError as error:
        raise ValueError("expected a number that a float can hold") from error
    except Exception as error:
        raise TypeError("expected a real number") from error


def _complex(value: Any) -> Any:
    if isinstance(value, complex):
        return value
    return complex(value) if isinstance(value, np.complexfloating) else _real(value)


def _whole(value: Any) -> int:
    if isinstance(value, str | bytes | bool):
        raise TypeError("expected a whole number")
    try:
        number = operator.index(value)
    except Exception as error:
        raise TypeError("expected a whole number") from error
    if not -(1 << 63) <= number < 1 << 63:
        raise ValueError("expected a whole number of 64 bits")
    return value if isinstance(value, int) else number


def _truth(value: Any) -> bool:
    if not isinstance(value, bool | np.bool_):
        raise TypeError("expected True or False")
    return bool(value)


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError("expected text")
    return value


def _check_path(value: Any) -> Any:
    """Path, or text that is one, whose names are possible."""
    if not isinstance(value, str | Path):
        raise TypeError("expected a path")
    parts = os.fsencode(value).split(b"/")
    if any(len(part) > MAX_NAME or b"\0" in part for part in parts):
        raise ValueError(f"expected a path of names of at most {MAX_NAME} bytes, without NUL")
    return value


def _array(letter: str, value: Any) -> Any:
    """Array of a kind of numbers; no copy of one that is right."""
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        raise ValueError("expected no masked values; leave them out or fill them")
    expected = f"expected an array of {_KINDS[letter]}"
    try:
        array = np.asarray(value)
    except Exception as error:
        raise TypeError(expected) from error
    if array.dtype.kind not in "biufc" and not (array.size == 0 and array.dtype.kind != "O"):
        raise TypeError(expected)
    if array.dtype.kind == "c" and letter != "c":
        if np.any(array.imag):
            raise TypeError(expected)
        array = array.real
    if letter == "i" and array.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            if not np.all(array == np.trunc(np.where(np.isfinite(array), array, 0.5))):
                raise TypeError(expected)
    return array


def _choice(choices: tuple[Any, ...], value: Any) -> Any:
    if isinstance(value, str | int | None) and value in choices:
        return value
    raise ValueError(f"expected {' or '.join(map(repr, choices))}")


def _member(kind: type[enum.Enum], value: Any) -> Any:
    try:
        return kind(value)
    except ValueError as error:
        raise ValueError(f"expected {' or '.join(repr(each.value) for each in kind)}") from error


def _items(item: Converter, kind: Any, value: Any) -> Any:
    """Sequence with items of a type; one that may load its items is left to itself."""
    zero = getattr(value, "shape", None) == ()  # of a scalar's array
    if isinstance(value, str | bytes | Mapping | set) or zero or not isinstance(value, Iterable):
        raise TypeError("expected a sequence")
    if isinstance(value, tuple | list):
        made = tuple(map(item, value))
        if kind is not tuple and all(map(operator.is_, made, value)):
            return value
        return list(made) if kind is list else made
    loads = isinstance(value, Iterator) or (isinstance(value, Sequence) and not _foreign(value))
    return value if loads and kind in (Sequence, Iterable) else tuple(map(item, value))


def _row(items: tuple[Converter, ...], value: Any) -> Any:
    made = _items(_identity, tuple, value)
    if len(made) != len(items):
        raise ValueError(f"expected {len(items)} items")
    return tuple(rule(each) for rule, each in zip(items, made, strict=True))


def _convert_union(members: tuple[Converter, ...], value: Any) -> Any:
    reasons = []
    for member in members:
        try:
            return member(value)
        except (TypeError, ValueError) as error:
            reasons.append(str(error).removeprefix("expected "))
    raise TypeError(f"expected {' or '.join(dict.fromkeys(reasons))}")


def _foreign(value: Any) -> bool:
    """Whether a value is of Python or of a library of numbers."""
    return type(value).__module__.partition(".")[0] in _FOREIGN


def _instance(kind: type, value: Any) -> Any:
    """Instance of a class, or a stand-in of the caller's own."""
    own = type(value).__module__.partition(".")[0] == "eitskin"
    if isinstance(value, kind) or not (own or _foreign(value)):
        return value
    raise TypeError(f"expected {'None' if kind is types.NoneType else f'a {kind.__name__}'}")


_PLAIN: dict[Any, Converter] = {
    float: _real,
    complex: _complex,
    int: _whole,
    bool: _truth,
    str: _text,
    Path: _check_path,
    ArrayLike: partial(_array, "c"),
    Any: _identity,
    object: _identity,
}
_SEQUENCES = (tuple, list, Sequence, Iterable)
_LETTERS = (("f", np.floating), ("i", np.integer), ("b", np.bool_))
