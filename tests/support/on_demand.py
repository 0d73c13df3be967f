"""Heavy packages, loaded by the test that uses them: both processes collect all test files."""

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
        return getattr(import_module(self._name), attribute)
