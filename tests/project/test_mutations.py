"""The list of mutations fits the tree; `make mutations` tries them, which takes minutes."""

import re

import pytest

from mutations.run import ROOT, Mutation, listed

MUTATIONS = listed()


def test_the_list_is_long_says_everything_once_and_can_be_applied():
    assert len(MUTATIONS) >= 40
    assert len({(each.file, each.old, each.new) for each in MUTATIONS}) == len(MUTATIONS)
    assert len({each.what for each in MUTATIONS}) == len(MUTATIONS)
    for mutation in MUTATIONS:
        applied = mutation.applied()
        assert applied != (ROOT / mutation.file).read_text(encoding="utf-8"), mutation.what
        compile(applied, mutation.file, "exec")
        for test in mutation.tests:
            file, *names = test.split("::")
            text = (ROOT / "tests" / file).read_text(encoding="utf-8")
            assert all(re.search(rf"(def|class) {name}\b", text) for name in names), mutation.what
    lost = Mutation("lost", "eitskin/protocol.py", "what was never there", "", ())
    with pytest.raises(ValueError, match=r"lost.*'what was never there'.* 0 times"):
        lost.applied()
