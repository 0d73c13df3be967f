"""House words stay out of pages, help and docstrings: each has a word that readers know."""

import re
from pathlib import Path

import pytest
import typer

from eitskin.cli.main import app

ROOT = Path(__file__).resolve().parents[2]
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
PAGES = [p for p in PAGES if p.parent.name != "results"]
WORDS = {
    r"told|tells?|telling": "is reported, shows, estimates, specifies, distinguishes",
    r"errs?": "has an error of",
    r"said|felt": "estimate, output",
    r"anew": "again",
    r"by (?:itself|themselves)|of itself": "on its own",
    r"(?:was|were|is|are) at hand|at hand": "available",
    r"as it comes|that which ships|comes with eitskin|out of the box": "pretrained",
    r"of (?:one|somebody)'s own": "custom, your",
    r"knows no|by heart": "does not use, overfits",
    r"plain twin": "reference implementation",
    r"rooms|(?-i:hall)": "package, module",
    r"a fault of eitskin": "a bug in eitskin",
    r"other hands|judged|judges?": "independent, tested",
    r"beside": "next to, compared with, besides",
    r"wanted are|wanted were": "the target is",
}
PATTERN = {re.compile(rf"\b(?:{word})\b", re.IGNORECASE): better for word, better in WORDS.items()}


def house_words(text):
    """House words in a text, each with what to write."""
    found = ((pattern.search(text), better) for pattern, better in PATTERN.items())
    return [f"{match[0]!r}: write {better}" for match, better in found if match]


def prose(page):
    """Text of a page without code and error messages."""
    text = re.sub(r"^ *```.*?^ *```", "", page.read_text(encoding="utf-8"), flags=re.S | re.M)
    return re.sub(r"`[^`\n]*`|^ {4}.*$", "", text, flags=re.MULTILINE)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_page_has_none(page):
    assert not house_words(prose(page))


def helps(command, name="eitskin"):
    """Texts of the help of a command and of all below it, by name."""
    yield name, command.help or ""
    for parameter in command.params:
        yield f"{name} {parameter.name}", getattr(parameter, "help", "") or ""
    for member, below in getattr(command, "commands", {}).items():
        if not below.hidden:
            yield from helps(below, f"{name} {member}")


def test_help_has_none_and_a_house_word_would_be_seen():
    texts = dict(helps(typer.main.get_command(app)))
    assert len(texts) > 200
    assert not {name: words for name, text in texts.items() if (words := house_words(text))}
    assert house_words("The angle errs by a degree.")
    assert not house_words("The angle has an error of a degree.")
