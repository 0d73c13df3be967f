"""Docstrings: every public name has one, every array in it a shape or a unit, in plain words.

Names of functions: verbs, or nouns with their quantity; no participle or preposition alone.
"""

import ast
import doctest
import importlib
import inspect
import io
import re
import tokenize
from functools import cache
from pathlib import Path

import pytest
from project.test_docs import house_words

pytestmark = pytest.mark.slow

PACKAGES = ("geometry", "simulator", "datasets", "training", "hardware")
ARRAY = re.compile(r"ndarray|NDArray|ArrayLike")
SHAPE_OR_UNIT = re.compile(r"\([^)]*[,\w][^)]*\)|\[[^]]+\]")
ROOT = Path(__file__).parents[2]
ROOMS = ("eitskin", *PACKAGES, "cli", "benchmarks")


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
                    yield f"{package}.{name}.{member}", getattr(thing, member)


NAMES = dict(public())


def described(docstring, attribute):
    """What the docstring's list says of an attribute, its further lines included."""
    found = re.search(
        rf"^ *(?:\w+, )*{attribute}(?:, \w+)*: (.*(?:\n {{8,}}.*)*)", docstring, re.MULTILINE
    )
    return found[1] if found else ""


def test_public_names_have_docstrings_whose_arrays_have_shapes_or_units():
    assert len(NAMES) > 300
    for name, thing in NAMES.items():
        said = inspect.getdoc(thing)
        assert said, f"{name}: no docstring"
        assert re.fullmatch(r"\S.*[.:]", said.splitlines()[0]), f"{name}: {said.splitlines()[0]}"
    for name, thing in NAMES.items():
        said = inspect.getdoc(thing)
        if not inspect.isclass(thing):
            returned = getattr(thing, "fget", thing).__annotations__.get("return", "")
            assert not ARRAY.search(str(returned)) or SHAPE_OR_UNIT.search(said), f"{name}: {said}"
            continue
        for attribute, kind in vars(thing).get("__annotations__", {}).items():
            if ARRAY.search(str(kind)) and not attribute.startswith("_"):
                text = described(said, attribute)
                assert SHAPE_OR_UNIT.search(text), f"{name}.{attribute}: {text or 'not described'}"
    assert all(map(breaks_rule, ["kept", "_solved", "of", "_at_end", "nodes_of", "mapped"]))
    assert not any(map(breaks_rule, ["from_design", "extra_depth", "with_noise", "_solve", "seed"]))


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_class_and_function_has_an_example_that_runs(package, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    for name, thing in NAMES.items():
        if name.startswith(f"{package}.") and name.count(".") == 1:
            text = inspect.getdoc(thing)
            assert ">>>" in text or name == "simulator.Tolerance", name  # which is a number
            runner.run(doctest.DocTestParser().get_doctest(text, {}, name, None, 0))
    assert runner.summarize(verbose=False).failed == 0


@cache
def parsed(path):
    """Syntax tree of a file."""
    return ast.parse(path.read_text(encoding="utf-8"))


def undocumented(room):
    """Public methods without a docstring, each with its class; ruff holds all that is no method."""
    for path in sorted((ROOT / room).rglob("*.py")):
        inside = path.relative_to(ROOT).with_suffix("").parts
        module = ".".join(inside if room == "eitskin" else ("eitskin", *inside))
        for owner in parsed(path).body:
            if not isinstance(owner, ast.ClassDef) or owner.name.startswith("_"):
                continue
            for method in owner.body:
                if isinstance(method, ast.FunctionDef | ast.AsyncFunctionDef) and not (
                    method.name.startswith("_") or ast.get_docstring(method)
                ):
                    yield module, owner.name, method.name


def overrides_a_documented_one(module, owner, method):
    """Whether a base class says what the method does."""
    bases = getattr(importlib.import_module(module), owner).__mro__[1:]
    return any(inspect.getdoc(vars(base).get(method)) for base in bases if method in vars(base))


@pytest.mark.parametrize("room", ROOMS)
def test_every_public_method_or_the_one_it_overrides_is_documented(room):
    missing = [names for names in undocumented(room) if not overrides_a_documented_one(*names)]
    assert not missing


SENTENCE_BY_OF_OR_WHAT = re.compile(r"(?:^|[.!?]\s+|\n\s*\n\s*|\n *[-*] )(?:Of|What)\b.{,60}")


@cache
def docstrings(path):
    """Docstrings of a module and of all in it, private names included."""
    described = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
    nodes = [node for node in ast.walk(parsed(path)) if isinstance(node, described)]
    return [ast.get_docstring(node) or "" for node in nodes]


def comments(source):
    """Comments, those of lines in a row as one; none where no line with one has such a word."""
    if not re.search(r"#.*\b(?:Of|What)\b", source):
        return  # as most files: reading them by tokens takes seconds
    last, text = 0, ""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            if token.start[0] != last + 1:
                yield text
                text = ""
            last, text = token.start[0], f"{text} {token.string.lstrip('# ')}".strip()
    yield text


@pytest.mark.parametrize("room", [*ROOMS, "docs"])
def test_docstrings_begin_with_a_line_and_no_sentence_with_of_or_what(room):
    for path in sorted((ROOT / room).rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        for text in (*docstrings(path), *comments(source)):
            assert not SENTENCE_BY_OF_OR_WHAT.search(text), (path, text)
        for text in docstrings(path) if room != "docs" else ():
            assert not text or re.search(r"[.:!?]$", text.splitlines()[0]), (path, text)
            assert not house_words(re.sub(r"`[^`]*`", "", text)), (path, text)


PARTICIPLE = re.compile(
    "kept|told|seen|found|given|taken|made|said|felt|left|held|drawn|built|shown|grown|begun|bent|"
    "brought|chosen|done|driven|gone|heard|hidden|laid|lent|lost|meant|met|sent|shaken|shot|sold|"
    "spent|stuck|sunk|swept|taught|thought|thrown|understood|unseen|written|risen|overtaken|broken|"
    "spoken|proven|worn|torn|known|unknown|(?!.*(?:seed|feed|need|speed|ceed|embed|shed)$).{3,}ed"
)
PREPOSITION = re.compile(
    "of|at|among|by|on|in|into|onto|off|over|under|above|below|to|from|with|without|for|than|up|"
    "through|towards?|upon|within|between|beyond|besides?|against|along|across|after|before|behind|"
    "around|about|aside|apart|away|near|since|until|via"
)
FIRST = {"from", "with", "without", "to", "as", "in", "on", "per", "for", "before", "after"}
OLD = {"Board.lost", "TextBoard.lost", "Estimate.found", "RecordedTouches.found"}  # others use them


def breaks_rule(name):
    """Whether a name is a participle, a preposition, or words that hang on one."""
    words = name.strip("_").lower().split("_")
    if len(words) == 1:
        return bool(PARTICIPLE.fullmatch(words[0]) or PREPOSITION.fullmatch(words[0]))
    hanging = words[0] not in FIRST and PREPOSITION.fullmatch(words[0])
    return words[-1] in {"of", "at", "by", "to", "on"} or bool(hanging)


def functions(node, prefix=""):
    """Functions and methods below a node, by their qualified names."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
            yield prefix + child.name
        named = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
        yield from functions(child, f"{prefix}{child.name}." if named else prefix)


@pytest.mark.parametrize("package", ROOMS)
def test_functions_are_named_by_verbs_or_nouns(package):
    names = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in (ROOT / package).rglob("*.py")
        for name in functions(parsed(path))
        if name not in OLD and breaks_rule(name.rpartition(".")[2])
    }
    assert not names, "a function is named by what it does or by the quantity that it returns"
