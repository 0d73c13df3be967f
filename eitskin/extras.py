"""Imports when they are needed: optional packages ("extras"), and public names of a package."""

import ast
import importlib
import importlib.util
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

T = TypeVar("T")


def require(module: str, extra: str) -> ModuleType:
    """Import `module`; raises ImportError naming the extra of eitskin that installs it."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] != module.partition(".")[0]:
            raise
        raise ImportError(
            f"{module.partition('.')[0]} is needed here and is not installed; install it with "
            f"pip install 'eitskin[{extra}]'"
        ) from error


def require_all(**extras: str) -> None:
    """Check before long work that all packages it needs are installed, without importing them.

    For each extra, names of packages are separated by spaces. Raises ImportError that names the
    missing packages and the extras that install them.
    """
    missing = {
        name: extra
        for extra, names in extras.items()
        for name in names.split()
        if importlib.util.find_spec(name) is None
    }
    if missing:
        raise ImportError(
            f"needed here and not installed: {', '.join(missing)}; install with "
            f"pip install 'eitskin[{','.join(dict.fromkeys(missing.values()))}]'"
        )


def lazy_exports(
    package: str, file: str
) -> tuple[list[str], Callable[[str], object], Callable[[], list[str]]]:
    """`__all__`, `__getattr__` and `__dir__` of a package (PEP 562), from its stub `__init__.pyi`.

    The stub next to `file` lists the public names and their modules once, for type checkers and for
    this function: `from eitskin.geometry.design.sensor import Layer as Layer`. Importing the
    package imports none of these modules. Arguments are converted by `eitskin.arguments`.

    Args:
        package: its `__name__`.
        file: its `__file__`.
    """
    stub = ast.parse(Path(file).with_suffix(".pyi").read_text(encoding="utf-8"))
    homes = {
        alias.name: statement.module
        for statement in stub.body
        if isinstance(statement, ast.ImportFrom) and statement.module
        for alias in statement.names
    }

    def getattribute(name: str) -> object:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        from eitskin.arguments import convert_arguments  # which needs numpy

        value = convert_arguments(getattr(importlib.import_module(homes[name]), name))
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        return sorted({"__doc__", "__file__", "__name__", "__path__", *homes})

    return sorted(homes), getattribute, names


class _OldName:
    """Old name of a member of a public class: it warns, and stands for the new one."""

    def __init__(self, old: str, new: str) -> None:
        self.old, self.new = old, new

    def __get__(self, instance: object, owner: type) -> Any:
        message = f"{owner.__name__}.{self.old} is deprecated; use {self.new}"
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        return getattr(owner if instance is None else instance, self.new)


def old_names(**names: str) -> Callable[[type[T]], type[T]]:
    """Decorator of a class whose members had other names: the new name of each old one."""

    def add_old_names(kind: type[T]) -> type[T]:
        for old, new in names.items():
            setattr(kind, old, _OldName(old, new))
        return kind

    return add_old_names
