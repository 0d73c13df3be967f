"""Size of every package against the budget in docs/architecture.md."""

import re
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
ROW = re.compile(r"^\| `(\w+)` \| ([\d,]+) \| ([\d,]+) \| (\d*) ?\|$", re.MULTILINE)
BUDGET = {
    name: [int(n.replace(",", "") or 0) for n in numbers] for name, *numbers in ROW.findall(PAGE)
}


@pytest.fixture(scope="module")
def depth():
    """Length of the longest chain of imports that begins at a module, lazy ones included."""
    import grimp

    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / ".types")  # where the packages lie under one folder
        patch.delitem(sys.modules, "eitskin")
        graph = grimp.build_graph("eitskin", cache_dir=None)

    @cache
    def chain(module):
        imported = graph.find_modules_directly_imported_by(module)
        return 1 + max(map(chain, imported), default=0)

    return lambda name: max(chain(m) for m in graph.modules if m.split(".")[1:2] == [name])


def test_every_package_has_a_budget():
    assert {"eitskin", "tests"} < set(BUDGET)
    assert {path.parent.name for path in ROOT.glob("*/__init__.py")} <= set(BUDGET)


@pytest.mark.parametrize("name", BUDGET)
def test_no_package_is_over_its_budget(name, depth):
    """Whoever adds takes something out, or raises the number in the same commit with its reason."""
    modules = sorted((ROOT / name).rglob("*.py"))
    lines = sum(len(module.read_text(encoding="utf-8").splitlines()) for module in modules)
    max_lines, max_modules, max_depth = BUDGET[name]
    assert lines <= max_lines, f"{name}: {lines} lines, {max_lines} allowed"
    assert len(modules) <= max_modules, f"{name}: {len(modules)} modules, {max_modules} allowed"
    if max_depth:
        assert depth(name) <= max_depth
