"""What several test files need and takes long to make: made once in a run, for all processes."""

import fcntl
import os
from collections.abc import Callable
from pathlib import Path


def made_once(factory, name: str, make: Callable[[Path], object]) -> Path:
    """The folder or file `name` that `make` writes, by whichever process asks first.

    The others wait for it. Whoever reads it must leave it as it is.
    """
    base = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent  # that of all workers
    made, begun = base / name, base / f"begun-{name}"
    with (base / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.exists():
            make(begun)
            begun.rename(made)
    return made
