"""What the pages say can be followed: links lead somewhere, code is code, commands exist."""

import importlib.util
import pkgutil
import re
import shlex
import textwrap
import tomllib
from pathlib import Path

import pytest
import typer

from eitskin.cli.main import app

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(
    [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "hardware").rglob("*.md")]
)
FENCE = re.compile(r"^ *```(\w*)\n(.*?)^ *```$", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"(?:^|(?<=\n\n))((?:(?: {4}.*)?\n)+)", re.MULTILINE)
CODE_SPAN = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
LINK = re.compile(r"\]\(([^)\s]+)\)")
ROOMS = ("geometry", "simulator", "datasets", "training", "hardware")
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
                tomllib.loads(body)

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


def test_a_wrong_link_option_or_command_would_be_seen(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("[a](nowhere.md) `eitskin train DIR --ot x`\n\n    eitskin trian DIR  # go\n")
    assert LINK.findall(prose(page)) == ["nowhere.md"]
    assert commands(page) == ["eitskin trian DIR", "eitskin train DIR --ot x"]
    with pytest.raises(AssertionError, match="trian"):
        require_known(["trian", "DIR"])
    with pytest.raises(USAGE_ERROR, match="--ot"):
        require_known(["train", "DIR", "--ot", "x"])
    assert list(alternatives("eitskin export mcap\\|vtu [--out X]")) == [
        ["export", "mcap", "--out", "X"],
        ["export", "vtu", "--out", "X"],
    ]


def test_every_page_of_docs_is_on_the_map():
    index = (ROOT / "docs" / "index.md").read_text()
    linked = {(ROOT / "docs" / target.split("#")[0]).resolve() for target in LINK.findall(index)}
    pages = {page for page in PAGES if page.is_relative_to(ROOT / "docs")}
    missing = pages - linked - {ROOT / "docs" / "index.md"}
    assert not missing, f"link from docs/index.md: {sorted(map(str, missing))}"


def test_what_the_physics_names_is_there():
    text = (ROOT / "docs" / "physics.md").read_text()
    computed = re.findall(r"`(eitskin[\w.]+)`", text)
    held = re.findall(r"`(test_\w+)(?:\.(test_\w+))?`", text)
    assert min(len(computed), len(held)) > 25
    for name in computed:
        assert pkgutil.resolve_name(name), name
    for module, test in held:
        source = "".join(path.read_text() for path in (ROOT / "tests").rglob(f"{module}.py"))
        assert source, f"docs/physics.md names {module}, and tests hold no {module}.py"
        assert not test or re.search(rf"^ *def {test}\(", source, re.MULTILINE), f"{module}.{test}"


def test_the_reference_of_the_site_names_every_room_and_modules_that_exist():
    names = []
    for page in sorted((ROOT / "docs" / "site").glob("*.rst")):
        names += re.findall(r"^\.\. automodule:: (eitskin[\w.]*)$", page.read_text(), re.MULTILINE)
    assert {f"eitskin.{room}" for room in ROOMS} <= set(names)
    for name in names:
        assert importlib.util.find_spec(name), name
