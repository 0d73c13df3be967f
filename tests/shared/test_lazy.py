"""Lazy public names: what a stub lists is there, and is imported on first access only."""

import importlib
import sys

import pytest

STUB = """
from lazy_package.first import One as One
from lazy_package.first import Two as Two
from lazy_package.second import Three as Three
from lazy_package.second import Absent as Absent
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package of two modules; its stub names one thing that the second does not define."""
    folder = tmp_path / "lazy_package"
    folder.mkdir()
    (folder / "__init__.py").write_text(
        "from eitskin.extras import lazy_exports\n"
        "__all__, __getattr__, __dir__ = lazy_exports(__name__, __file__)\n"
    )
    (folder / "__init__.pyi").write_text(STUB)
    (folder / "first.py").write_text("class One: ...\nclass Two: ...\n")
    (folder / "second.py").write_text("Three = object()\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield importlib.import_module("lazy_package")
    for name in [name for name in sys.modules if name.partition(".")[0] == "lazy_package"]:
        del sys.modules[name]


def test_the_names_are_those_of_the_stub(package) -> None:
    assert package.__all__ == ["Absent", "One", "Three", "Two"]
    assert set(package.__all__) < set(dir(package))


def test_a_module_is_imported_when_one_of_its_names_is_asked_for(package) -> None:
    assert "lazy_package.first" not in sys.modules
    assert package.One.__module__ == "lazy_package.first"
    assert "lazy_package.first" in sys.modules
    assert "lazy_package.second" not in sys.modules


def test_a_name_is_looked_up_once(package, monkeypatch) -> None:
    assert "Three" not in vars(package)
    found = package.Three
    assert vars(package)["Three"] is found
    monkeypatch.delitem(vars(package), "__getattr__")
    assert package.Three is found


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Four", "'lazy_package' has no attribute 'Four'"),
        ("Absent", r"'lazy_package\.second' has no attribute 'Absent'"),
    ],
)
def test_a_name_absent_from_the_stub_or_from_its_module_is_missing(package, name, message) -> None:
    with pytest.raises(AttributeError, match=message):
        getattr(package, name)
