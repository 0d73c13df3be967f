"""Heavy packages, loaded by the test that uses them: both processes collect all test files."""

import os
from importlib import import_module
from importlib.util import find_spec

import pytest


class OnDemand:
    """Module `name`, loaded at its first use; its users are skipped where it is not installed."""

    def __init__(self, name):
        package = name.partition(".")[0]
        if find_spec(package) is None:
            pytest.skip(f"could not import {package!r}", allow_module_level=True)
        self._name = name

    def __getattr__(self, attribute):
        if attribute.startswith("_"):  # which pytest asks of everything in a module
            raise AttributeError(attribute)
        return getattr(import_module(self._name), attribute)


def require_kernels():
    """Skip the module where kernels are not compiled."""
    if os.environ.get("EITSKIN_PLAIN") or find_spec("numba") is None:
        pytest.skip("needs the extra `fast`, without EITSKIN_PLAIN", allow_module_level=True)
