"""Packages that not every scene needs, loaded where they are used."""

import importlib
from types import ModuleType


def require(module: str, extra: str) -> ModuleType:
    """Import `module`; where it is missing, say which extra of eitskin brings it."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] != module.partition(".")[0]:
            raise
        raise ImportError(
            f"{module.partition('.')[0]} is needed here and is not installed; install it with "
            f"pip install 'eitskin[{extra}]'"
        ) from error
