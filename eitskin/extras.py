"""Packages that not every scene needs, loaded where they are used."""

import importlib
import importlib.util
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


def require_all(**extras: str) -> None:
    """Say at once, before long work, which of the packages that it will need are missing.

    Nothing is imported, which would take seconds.

    Args:
        extras: the names of packages of each extra, with spaces between.

    Raises:
        ImportError: names what is missing, and the extras that bring it.
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
