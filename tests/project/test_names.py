"""Names of functions: verbs, or nouns with their quantity; no participle or preposition alone."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("eitskin", "geometry", "simulator", "datasets", "training", "hardware", "cli")
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


@pytest.mark.parametrize("package", [*PACKAGES, "benchmarks"])
def test_functions_are_named_by_verbs_or_nouns(package):
    names = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in (ROOT / package).rglob("*.py")
        for name in functions(ast.parse(path.read_text(encoding="utf-8")))
        if name not in OLD and breaks_rule(name.rpartition(".")[2])
    }
    assert not names, "a function is named by what it does or by the quantity that it returns"


def test_such_names_would_be_noticed():
    assert all(map(breaks_rule, ["kept", "_solved", "of", "_at_end", "nodes_of", "mapped"]))
    assert not any(map(breaks_rule, ["from_design", "extra_depth", "with_noise", "_solve", "seed"]))
