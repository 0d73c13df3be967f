"""The list of bugs fits the tree; `make mutations` tries it and the draw, which takes an hour."""

import re

from mutations.run import ROOT, listed_bugs


def test_bugs_of_the_list_can_be_put_in_and_their_tests_are_there():
    bugs = listed_bugs()
    assert len({each.what for each in bugs}) == len(bugs) >= 10
    for bug in bugs:
        compile(bug.text, bug.file, "exec")
        file, test = bug.tests[0].split("::")
        text = (ROOT / "tests" / file).read_text(encoding="utf-8")
        assert re.search(rf"^def {test}\(", text, re.MULTILINE), bug.what
