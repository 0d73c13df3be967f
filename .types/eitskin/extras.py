"""Optional packages ("extras"), imported where they are used."""

import importlib
import importlib.util
from types import ModuleType


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

    Args:
        extras: for each extra, the names of packages, separated by spaces.

    Raises:
        ImportError: names the missing packages and the extras that install them.
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
