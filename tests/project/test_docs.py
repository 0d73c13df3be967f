"""Pages: links, commands, words, and what they say of the code and the board."""

import csv
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

    def test_it_has_no_house_words(self, page):
        """Those that only we know: each has a word that readers know."""
        text = re.sub("^ {4}.*$", "", prose(page), flags=re.MULTILINE)
        assert page in RESULTS or not house_words(text)

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


def test_pages_are_few_short_on_the_map_with_examples_and_made_from_the_code():
    counts = {page: words(page) for page in [*WRITTEN, *GENERATED] if page != ARCHITECTURE}
    assert len(counts) <= MAX_PAGES
    assert sum(counts.values()) <= MAX_ALL_WORDS
    assert not {page for page, count in counts.items() if count > MAX_WORDS} - GENERATED
    assert len((ROOT / "README.md").read_text().splitlines()) <= 110
    index = DOCS / "index.md"
    assert not {*WRITTEN, *GENERATED} - set(RESULTS) - links(index) - {index}
    assert not set(RESULTS) - links(DOCS / "explanation" / "results.md")
    text = (DOCS / "explanation" / "physics.md").read_text()
    computed = re.findall(r"`(eitskin[\w.]+)`", text)
    assert len(computed) > 15
    for name in computed:
        assert pkgutil.resolve_name(name), name
    pages = runpy.run_path(str(DOCS / "site" / "reference.py"))["PAGES"]
    for name, page in pages.items():
        assert (DOCS / "reference" / name).read_text() == page(), "run `make pages`"
    assert len(paths()) > 35
    assert not [path for path in paths() if len(command_examples(path)) != 2]


def helps(command=COMMAND, name="eitskin"):
    """Texts of the help of a command and of all below it, by name."""
    yield name, command.help or ""
    for parameter in command.params:
        yield f"{name} {parameter.name}", getattr(parameter, "help", "") or ""
    for member, below in getattr(command, "commands", {}).items():
        if not below.hidden:
            yield from helps(below, f"{name} {member}")


def test_help_has_no_house_words_and_one_would_be_seen():
    texts = dict(helps())
    assert len(texts) > 200
    assert not {name: words for name, text in texts.items() if (words := house_words(text))}
    assert house_words("The angle errs by a degree.")
    assert not house_words("The angle has an error of a degree.")


def links(page):
    """Paths that a page links to."""
    return {(page.parent / target.split("#")[0]).resolve() for target in LINK.findall(prose(page))}


def paths(command=COMMAND, path="eitskin"):
    """Names of all commands that have no others below them."""
    below = getattr(command, "commands", {}).items()
    return [p for name, c in below if not c.hidden for p in paths(c, f"{path} {name}")] or [path]


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


def test_version_licence_and_cards_are_those_of_the_package():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert CITATION["version"] == eitskin.__version__
    assert CITATION["license"] == project["license"]
    (paper,) = CITATION["references"]
    assert paper["title"] in PAPER
    assert paper["journal"] in PAPER
    assert paper["doi"] in PAPER
    assert all(each["family-names"] in PAPER for each in paper["authors"])
    data = Dataset.from_arrays(np.ones((1, 1)))
    assert CITATION["title"] in card("set", "mit", {"train": (1, 1)}, data, ())


# The page of the board


FOLDER = ROOT / "hardware" / "firmware" / "nucleo_f411"
PAGE = FOLDER / "README.md"
SCHEMATIC = ROOT / "docs" / "how-to" / "board" / "schematic.py"
COMMON = {"U1": "CE0, by C1", "U2": "AIN1, by C2", "U3": "AIN2", "U4": "AIN3"}


def rows(name):
    with (FOLDER / name).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_schematic_page_and_firmware_have_the_wires_of_the_multiplexers():
    drawn = runpy.run_path(str(SCHEMATIC))["draw"](rows("wiring.csv"))
    assert SCHEMATIC.with_suffix(".svg").read_text(encoding="utf-8") == drawn
    wires = {row["goes to"]: row for row in rows("wiring.csv")}
    for part, role in zip(COMMON, ("F+", "F-", "S+", "S-"), strict=True):
        lines = [wires[f"{part} A{line}"] for line in range(4)]
        assert all(row["signal"].startswith(f"{role} A") for row in lines)
        cells = [f"{row['pin']}, {row['header']}" for row in lines]
        table_row = f"| {part} ({role}) | {' | '.join(cells)} | {COMMON[part]} |"
        assert table_row in PAGE.read_text(encoding="utf-8")
    source = (FOLDER / "front_end.c").read_text(encoding="utf-8")
    names = {"F+": "DRIVE_PLUS", "F-": "DRIVE_MINUS", "S+": "SENSE_PLUS", "S-": "SENSE_MINUS"}
    pins = {row["signal"]: row["pin"] for row in rows("wiring.csv")}
    assert len(set(pins.values())) == len(pins) == 24
    for role, name in names.items():
        (line,) = re.findall(rf"\[EIT_{name}\] = (.*),", source)
        driven = [f"P{port}{number}" for port, number in re.findall(r"GPIO(\w), (\d+)", line)]
        assert driven == [pins[f"{role} A{line}"] for line in range(4)]
    bought = {part for row in rows("bill_of_materials.csv") for part in row["reference"].split()}
    drawn = SCHEMATIC.with_suffix(".svg").read_text(encoding="utf-8")
    shown = {"U1", "U2", "U3", "U4", "C1", "C2", "C7", "R1", "R2", "R3"}
    assert all(part in drawn for part in shown)
    assert bought == shown | {"C3", "C4", "C5", "C6"}
