"""The list of mutations fits the tree; `make mutations` tries them, which takes minutes."""

import re

import pytest

from mutations.run import ROOT, Mutation, listed

MUTATIONS = listed()


def test_the_list_is_long_and_says_everything_once():
    assert len(MUTATIONS) >= 40
    assert len({(each.file, each.old, each.new) for each in MUTATIONS}) == len(MUTATIONS)
    assert len({each.what for each in MUTATIONS}) == len(MUTATIONS)


def test_each_can_be_applied_and_tested():
    for mutation in MUTATIONS:
        applied = mutation.applied()
        assert applied != (ROOT / mutation.file).read_text(encoding="utf-8"), mutation.what
        compile(applied, mutation.file, "exec")
        for test in mutation.tests:
            file, *names = test.split("::")
            text = (ROOT / "tests" / file).read_text(encoding="utf-8")
            assert all(re.search(rf"(def|class) {name}\b", text) for name in names), mutation.what


def test_text_that_is_gone_is_an_error():
    lost = Mutation("lost", "eitskin/protocol.py", "what was never there", "", ())
    with pytest.raises(ValueError, match=r"lost.*'what was never there'.* 0 times"):
        lost.applied()
