"""Every public name says what it is, and every array its shape or its unit."""

import importlib
import inspect
import re

import pytest

PACKAGES = ("geometry", "simulator", "datasets", "training", "hardware")
ARRAY = re.compile(r"ndarray|NDArray|ArrayLike")
SHAPE_OR_UNIT = re.compile(r"\([^)]*[,\w][^)]*\)|\[[^]]+\]")


def public():
    """Public classes and functions, then the public methods and properties of the classes."""
    for package in PACKAGES:
        module = importlib.import_module(f"eitskin.{package}")
        for name in module.__all__:
            thing = getattr(module, name)
            if not (inspect.isclass(thing) or inspect.isfunction(thing)):
                continue  # unions of types, and constants
            yield f"{package}.{name}", thing
            for member, value in vars(thing).items() if inspect.isclass(thing) else ():
                function = getattr(value, "fget", None) or getattr(value, "__func__", value)
                if not member.startswith("_") and inspect.isfunction(function):
                    yield f"{package}.{name}.{member}", function


NAMES = dict(public())


def described(docstring, attribute):
    """What the docstring's list says of an attribute, its further lines included."""
    found = re.search(
        rf"^ *(?:\w+, )*{attribute}(?:, \w+)*: (.*(?:\n {{8,}}.*)*)", docstring, re.MULTILINE
    )
    return found[1] if found else ""


@pytest.mark.parametrize("name", NAMES)
def test_the_first_line_is_a_sentence(name):
    said = inspect.getdoc(NAMES[name])
    assert said, "no docstring"
    assert re.fullmatch(r"\S.*[.:]", said.splitlines()[0]), said.splitlines()[0]


@pytest.mark.parametrize("name", [name for name in NAMES if inspect.isclass(NAMES[name])])
def test_every_array_of_a_class_has_a_shape_or_a_unit(name):
    thing = NAMES[name]
    said = inspect.getdoc(thing)
    for attribute, kind in vars(thing).get("__annotations__", {}).items():
        if ARRAY.search(str(kind)) and not attribute.startswith("_"):
            text = described(said, attribute)
            assert SHAPE_OR_UNIT.search(text), f"{attribute}: {text or 'not described'}"


@pytest.mark.parametrize("name", [name for name in NAMES if inspect.isfunction(NAMES[name])])
def test_every_array_that_is_returned_has_a_shape_or_a_unit(name):
    function = NAMES[name]
    if ARRAY.search(str(function.__annotations__.get("return", ""))):
        assert SHAPE_OR_UNIT.search(inspect.getdoc(function)), inspect.getdoc(function)
