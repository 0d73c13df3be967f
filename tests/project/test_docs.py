"""What the pages say: links lead somewhere, code is code, commands exist, citations agree."""

import importlib.util
import pkgutil
import re
import runpy
import shlex
import textwrap
import tomllib
from pathlib import Path

import numpy as np
import pytest
import typer
import yaml

import eitskin
from eitskin.cli.help import command_examples
from eitskin.cli.main import app
from eitskin.config import parse_toml
from eitskin.datasets import Dataset, Recipe, State
from eitskin.datasets.export.export import PAPER, card
from eitskin.geometry import Clamp, FreeArc, Hinge, SensorDesign
from eitskin.simulator import Mechanics, Scene

ROOT = Path(__file__).resolve().parents[2]
CITATION = yaml.safe_load((ROOT / "CITATION.cff").read_text())
PAGES = sorted(
    [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "hardware").rglob("*.md")]
)
FENCE = re.compile(r"^ *```(\w*)\n(.*?)^ *```$", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"(?:^|(?<=\n\n))((?:(?: {4}.*)?\n)+)", re.MULTILINE)
CODE_SPAN = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
LINK = re.compile(r"\]\(([^)\s]+)\)")
Fixture = Clamp | Hinge | FreeArc
COMMAND = typer.main.get_command(app)
USAGE_ERROR = typer.BadParameter.__base__
COMMENT = re.compile(r"\s+#\s.*$", re.MULTILINE)


def prose(page):
    """The page's text without its code."""
    return CODE_SPAN.sub("", FENCE.sub("", page.read_text()))


def anchors(page):
    """What its headings can be linked by, as GitHub names them."""
    headings = re.findall(r"^#+ (.+)$", FENCE.sub("", page.read_text()), re.MULTILINE)
    plain = (re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading) for heading in headings)
    return {re.sub(r"[^\w\- ]", "", each.strip().lower()).replace(" ", "-") for each in plain}


def commands(page):
    """Every command line of eitskin on the page, in blocks and between backticks."""
    text = page.read_text()
    blocks = [body for _, body in FENCE.findall(text)] + INDENTED.findall(FENCE.sub("", text))
    lines = COMMENT.sub("", "\n".join(blocks)).replace("\\\n", " ").splitlines()
    spans = CODE_SPAN.findall(FENCE.sub("", text))
    found = (line.strip().removeprefix("$ ") for line in [*lines, *spans])
    return [line for line in found if re.match(r"eitskin( [\w'\"$./:-]|$)", line)]


def alternatives(line):
    """The command lines that `a|b` on the page stands for; brackets mark what may be left out."""
    words = shlex.split(line.replace("\\|", "|").replace("[", " ").replace("]", " "))[1:]
    choices = [word.split("|") for word in words]
    for number in range(max(map(len, choices), default=1)):
        yield [choice[min(number, len(choice) - 1)] for choice in choices]


def require_known(words):
    """Walk down to the command and have it read its options; raises what it says of wrong ones."""
    command = COMMAND
    while hasattr(command, "commands") and words and not words[0].startswith("-"):
        name, *words = words
        assert name in command.commands, f"there is no command {name!r}"
        command = command.commands[name]
    if not hasattr(command, "commands"):
        command.make_parser(command.context_class(command)).parse_args([*words, "VALUE"])


def kind_of(table):
    """Dataclass that a TOML block of the guides is read as; None for a part of a file."""
    kinds = {"name": Recipe, "electrodes": SensorDesign, "gel": Mechanics, "touches": Scene}
    kinds |= {"span": Fixture, "length": Fixture, "bend": Scene}
    return next((kind for key, kind in kinds.items() if key in table), None)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
class TestPage:
    def test_its_links_lead_to_files_and_headings(self, page):
        for target in LINK.findall(prose(page)):
            if re.match(r"\w+:", target):
                continue
            path, _, anchor = target.partition("#")
            linked = (page.parent / path).resolve() if path else page
            assert linked.exists(), f"{target}: no such file"
            assert not anchor or anchor in anchors(linked), f"{target}: no such heading"

    def test_its_code_is_code(self, page):
        for language, block in FENCE.findall(page.read_text()):
            body = textwrap.dedent(block)
            if language == "python":
                compile(body, str(page), "exec")
            if language == "toml":
                kind = kind_of(table := tomllib.loads(body))
                if kind and "file" not in table.get("outline", {}):
                    parse_toml(kind, re.sub('sensor = "[a-z]*.toml"', "", body), str(page))

    def test_its_commands_and_their_options_exist(self, page):
        for line in commands(page):
            for words in alternatives(line):
                try:
                    require_known(words)
                except (USAGE_ERROR, AssertionError) as error:
                    pytest.fail(f"{line}: {error}")

    def test_its_modules_exist(self, page):
        for module in re.findall(r"python -m (eitskin[\w.]+)", page.read_text()):
            assert importlib.util.find_spec(module), module


DOCS = ROOT / "docs"
RESULTS = sorted((DOCS / "results").glob("*.md"))
GENERATED = {DOCS / "reference" / name for name in ("commands.md", "files.md")} | set(RESULTS)
WRITTEN = [page for page in PAGES if page.is_relative_to(DOCS) and page not in GENERATED]
ARCHITECTURE = DOCS / "architecture.md"  # for those who change the code
MAX_PAGES, MAX_WORDS, MAX_ALL_WORDS = 27, 1_500, 21_250


def words(page):
    """Number of words of a page, without code, formulas and the bars of tables."""
    text = re.sub(r"\$\$.*?\$\$", "", prose(page), flags=re.DOTALL)
    return sum(bool(re.search(r"\w", word)) for word in text.split())


def test_pages_are_few_and_short():
    counts = {page: words(page) for page in [*WRITTEN, *GENERATED] if page != ARCHITECTURE}
    assert len(counts) <= MAX_PAGES
    assert sum(counts.values()) <= MAX_ALL_WORDS
    assert not {page for page, count in counts.items() if count > MAX_WORDS} - GENERATED
    assert len((ROOT / "README.md").read_text().splitlines()) <= 110


def links(page):
    """Paths that a page links to."""
    return {(page.parent / target.split("#")[0]).resolve() for target in LINK.findall(prose(page))}


def test_every_page_is_on_the_map_and_every_result_is_linked():
    index = DOCS / "index.md"
    assert not {*WRITTEN, *GENERATED} - set(RESULTS) - links(index) - {index}
    assert not set(RESULTS) - links(DOCS / "explanation" / "results.md")


def test_what_the_physics_names_is_there():
    text = (DOCS / "explanation" / "physics.md").read_text()
    computed = re.findall(r"`(eitskin[\w.]+)`", text)
    assert len(computed) > 15
    for name in computed:
        assert pkgutil.resolve_name(name), name


def paths(command=COMMAND, path="eitskin"):
    """Names of all commands that have no others below them."""
    below = getattr(command, "commands", {}).items()
    return [p for name, c in below if not c.hidden for p in paths(c, f"{path} {name}")] or [path]


def test_every_command_has_two_examples():
    assert len(paths()) > 35
    assert not [path for path in paths() if len(command_examples(path)) != 2]


def test_pages_made_from_the_code_are_up_to_date():
    pages = runpy.run_path(str(DOCS / "site" / "reference.py"))["PAGES"]
    for name, page in pages.items():
        assert (DOCS / "reference" / name).read_text() == page(), "run `make pages`"


@pytest.mark.slow
def test_the_example_in_the_readme_finds_the_touch_that_it_simulates(capsys) -> None:
    page = (ROOT / "README.md").read_text()
    (example,) = re.findall(r"```python\n(.*?)```\n", page, re.DOTALL)
    scope: dict[str, object] = {}
    exec(compile(example, "README.md", "exec"), scope)  # noqa: S102
    estimate, scene = scope["estimate"], scope["scene"]
    (touch,) = scene.touches
    assert estimate.state is State.TOUCH
    assert estimate.bend_angle_deg == pytest.approx(scene.bend.angle_deg, abs=1.0)
    (found,) = estimate.touches
    assert found[:2] == pytest.approx((touch.x, touch.y), abs=3e-3)
    shown = capsys.readouterr().out
    assert f"```text\n{shown}```" in page, "the page shows what the example prints"


def test_version_and_licence_are_those_of_the_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert CITATION["version"] == eitskin.__version__
    assert CITATION["license"] == project["license"]


def test_cards_cite_the_same_software_and_paper() -> None:
    (paper,) = CITATION["references"]
    assert paper["title"] in PAPER
    assert paper["journal"] in PAPER
    assert paper["doi"] in PAPER
    assert all(each["family-names"] in PAPER for each in paper["authors"])
    data = Dataset.from_arrays(np.ones((1, 1)))
    assert CITATION["title"] in card("set", "mit", {"train": (1, 1)}, data, ())
