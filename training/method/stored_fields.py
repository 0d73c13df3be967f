"""Dataclasses that are saved as the arrays of their fields, by name.

Numbers, tuples of numbers and arrays are arrays of the field's name. Parts, which are such
dataclasses themselves, have names FIELD.NAME, or FIELD where they have a single field; in tuples of
parts or arrays the field's name is followed by the index. None is left out.
"""

from collections.abc import Mapping
from dataclasses import MISSING, astuple, dataclass, fields
from functools import cache
from itertools import count, takewhile
from types import NoneType, UnionType
from typing import Annotated, Any, Self, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

Arrays = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class StoredField:
    """How a field is stored, as `Annotated[type, StoredField(...)]`, where that is not by its name.

    Attributes:
        name: name of the array, or prefix of the arrays, in place of the field's. Numbers of
            several fields that share one are one array, in their order.
        single: whether the arrays are in single precision.
        stacked: whether a part, a dataclass of tuples of numbers, is one array, a row for each.
        given: whether the field is not stored, but given where the dataclass is restored.
    """

    name: str = ""
    single: bool = False
    stacked: bool = False
    given: bool = False


GIVEN_FIELD = StoredField(given=True)


class StoredFields:
    """Base of dataclasses that are saved as the arrays of their fields."""

    __slots__ = ()

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays from which `from_arrays` restores the fields, by name."""
        return field_arrays(self)

    @classmethod
    def from_arrays(cls, arrays: Arrays, **given: Any) -> Self:
        """Restore what `arrays` came from; see `restored_fields`."""
        return cls(**restored_fields(cls, arrays, **given))


def field_arrays(value: Any) -> dict[str, NDArray[Any]]:
    """Arrays of the fields of a dataclass, by name."""
    arrays: dict[str, NDArray[Any]] = {}
    for name, entries in _entries(value.__class__).items():
        values = [getattr(value, entry.name) for entry in entries]
        if len(values) > 1:
            arrays[name] = np.hstack(values)
        elif values[0] is not None:
            arrays |= _arrays(name, values[0], entries[0].kind, entries[0].how)
    return arrays


def restored_fields(kind: Any, arrays: Arrays, **given: Any) -> dict[str, Any]:
    """Values of the fields of a dataclass, by name, from the arrays of `field_arrays`.

    Args:
        kind: the dataclass.
        arrays: arrays by name; others may be among them. A field without any has its default, or is
            None where it may be.
        given: fields that are not stored and, by the name of a part, a mapping of its own.

    Raises KeyError where arrays are missing, and ValueError for another number of numbers.
    """
    values = dict(given)
    for name, entries in _entries(kind).items():
        first = entries[0]
        absent = name not in arrays and not arrays_with_prefix(name, arrays)
        if absent and not first.is_numbered and (first.default or first.optional):
            values |= {} if first.default else {first.name: None}
        elif _is_number(first.kind):
            numbers = np.ravel(arrays[name]).tolist()
            values |= {entry.name: _take(entry.kind, numbers) for entry in entries}
            if numbers:
                raise ValueError(f"expected {len(numbers)} numbers less in '{name}'")
        else:
            part = given.get(first.name, {})
            values[first.name] = _restore(name, arrays, first.kind, first.how, part)
    return values


def arrays_with_prefix(name: str, arrays: Arrays) -> dict[str, NDArray[Any]]:
    """Those of the arrays that are called NAME.REST, by the rest."""
    mine = (key for key in arrays if key.startswith(f"{name}."))
    return {key.removeprefix(f"{name}."): arrays[key] for key in mine}


def prefix_arrays(name: str, arrays: Arrays) -> dict[str, NDArray[Any]]:
    """Arrays with names NAME.REST, from the rest."""
    return {f"{name}.{suffix}": array for suffix, array in arrays.items()}


@dataclass(frozen=True, slots=True)
class _Entry:
    """A stored field: name, type other than None, and whether it may be None or has a default."""

    name: str
    kind: Any
    how: StoredField
    optional: bool
    default: bool

    @property
    def is_numbered(self) -> bool:
        """Whether it is a tuple of parts or arrays."""
        return get_origin(self.kind) is tuple and not _is_number(self.kind)


@cache
def _entries(kind: Any) -> dict[str, list[_Entry]]:
    """Stored fields of a dataclass, by the names of their arrays."""
    hints = get_type_hints(kind, include_extras=True)
    entries: dict[str, list[_Entry]] = {}
    for field in fields(kind):
        hint, how = hints[field.name], StoredField()
        if get_origin(hint) is Annotated:
            hint, how = get_args(hint)
        if how.given or not field.init:
            continue
        kinds = get_args(hint) if get_origin(hint) is UnionType else (hint,)
        own = _expand(next(kind for kind in kinds if kind is not NoneType))
        default = field.default is not MISSING or field.default_factory is not MISSING
        entry = _Entry(field.name, own, how, NoneType in kinds, default)
        entries.setdefault(how.name or field.name, []).append(entry)
    return entries


def _expand(kind: Any) -> Any:
    """Type behind an alias of a `type` statement, which NDArray is in some versions of numpy."""
    value = getattr(get_origin(kind), "__value__", None)
    return kind if value is None else value[get_args(kind)]


def _element(kind: Any) -> Any:
    """Type of the elements of a tuple; any other type itself."""
    return _expand(get_args(kind)[0]) if get_origin(kind) is tuple else kind


def _is_number(kind: Any) -> bool:
    """Whether it is the type of a number, or of a tuple of numbers."""
    element = _element(kind)
    return isinstance(element, type) and issubclass(element, int | float)


def _is_part(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, StoredFields)


def _dtype(kind: Any) -> Any:
    """Type of the numbers of an array, a number or a tuple; None for any."""
    element = _element(kind)
    if get_origin(element) is np.ndarray:
        (number,) = get_args(get_args(element)[1])
        return None if number in {Any, np.generic} else number
    return np.int64 if issubclass(element, int) and element is not bool else element


def _arrays(name: str, value: Any, kind: Any, how: StoredField) -> dict[str, NDArray[Any]]:
    if get_origin(kind) is tuple and not _is_number(kind):
        numbered = [(f"{name}{i}", each) for i, each in enumerate(value)]
        parts = (_arrays(key, each, _element(kind), how) for key, each in numbered)
        return {key: array for arrays in parts for key, array in arrays.items()}
    if how.stacked:
        return {name: np.array(astuple(value))}
    if not _is_part(kind) and get_origin(kind) is not Mapping:
        return {name: np.asarray(value, np.float32 if how.single else _dtype(kind))}
    arrays = value.arrays() if _is_part(kind) else value
    if _is_part(kind) and len(_entries(kind)) == 1:
        return dict.fromkeys([name], *arrays.values())
    return prefix_arrays(name, arrays)


def _restore(
    name: str, arrays: Arrays, kind: Any, how: StoredField, given: Mapping[str, Any]
) -> Any:
    if get_origin(kind) is tuple:
        stored_names = {key.partition(".")[0] for key in arrays}
        numbered = takewhile(stored_names.__contains__, (f"{name}{i}" for i in count()))
        return tuple(_restore(key, arrays, _element(kind), how, given) for key in numbered)
    if how.stacked:
        return kind(*map(tuple, arrays[name].astype(float).tolist()))
    if not _is_part(kind) and get_origin(kind) is not Mapping:
        return np.array(arrays[name], _dtype(kind))
    if _is_part(kind) and len(_entries(kind)) == 1:
        return kind.from_arrays(dict.fromkeys(_entries(kind), arrays[name]), **given)
    own = arrays_with_prefix(name, arrays)
    return kind.from_arrays(own, **given) if _is_part(kind) else own


def _take(kind: Any, numbers: list[Any]) -> Any:
    """The first of some numbers, which it is taken from, as a number or a tuple."""
    if get_origin(kind) is not tuple:
        return kind(numbers.pop(0))
    kinds = get_args(kind)
    if kinds[-1] is Ellipsis:
        kinds = kinds[:1] * len(numbers)
    return tuple(kind(numbers.pop(0)) for kind in kinds)
