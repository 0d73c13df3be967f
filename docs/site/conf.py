"""The site: the project's own Markdown, the gallery's scripts and the reference; `make docs`."""

import re
from pathlib import Path

from sphinx.application import Sphinx

import eitskin

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("geometry", "simulator", "datasets", "training", "hardware")

project = "eitskin"
release = eitskin.__version__
copyright = "the authors of eitskin"  # noqa: A001  the name that Sphinx wants
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]

# The sources stay where they are, so that links between pages are those of the checkout.
root_doc = "README"
include_patterns = [
    "*.md",
    "docs/*.md",
    "docs/**/*.md",
    "docs/site/*.rst",
    "hardware/firmware/README.md",
]
exclude_patterns = [
    *(f"{path.name}" for path in ROOT.iterdir() if path.is_dir() and path.name[0] == "."),
    *("benchmarks", "build", "cli", "datasets", "eitskin", "geometry", "simulator", "tests"),
    *("training", "docs/site/extra"),
]

myst_heading_anchors = 4
highlight_language = "text"
suppress_warnings = ["misc.highlighting_failure"]  # examples with "..." in them
nitpicky = False

html_theme = "furo"
html_title = "eitskin"
html_extra_path = ["extra"]  # index.html, which leads to the README
html_copy_source = False
html_show_sphinx = False
html_show_search_summary = False  # it would fetch pages, which files may not
html_theme_options = {"navigation_with_keys": True}

autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}
napoleon_use_ivar = True
default_role = "literal"  # single backticks, as in the Markdown

_SECTION = re.compile(r"^(Args|Attributes|Raises|Returns|Yields|Examples?|Notes?):$")
_LITERAL = re.compile(r"(`[^`]*`)")


def navigation(text: str) -> str:
    """Hidden tables of contents, one for each section of the map of all pages; each page once."""
    parts, known = [], set()
    for section in re.split(r"^## ", text, flags=re.MULTILINE)[1:]:
        caption, _, body = section.partition("\n")
        linked = re.findall(r"\]\(([^)#\s]+)\.md(?:#[^)]*)?\)", body)
        paths = [((ROOT / "docs" / each).resolve().relative_to(ROOT)) for each in linked]
        pages = [str(path) for path in dict.fromkeys(paths) if str(path) not in known]
        pages = [page for page in pages if page not in (root_doc, "CONTRIBUTING")]
        known |= set(pages)
        if pages:
            parts.append(_contents(caption, pages))
    parts.append(_contents("Reference", [f"docs/site/{room}" for room in ROOMS]))
    return "\n".join(parts)


def _contents(caption: str, pages: list[str]) -> str:
    entries = "\n".join(f"/{page}" for page in pages)
    return f"\n```{{toctree}}\n:caption: {caption}\n:hidden:\n\n{entries}\n```\n"


def with_scripts(text: str) -> str:
    """The gallery, with each script folded under its picture."""
    return re.sub(
        r"^\[(\w+\.py)\]\(\1\):(?:.+\n)+",
        lambda found: (
            f"{found[0]}\n<details><summary>{found[1]}</summary>\n\n"
            f"```{{literalinclude}} {found[1]}\n:language: python\n```\n\n</details>\n"
        ),
        text,
        flags=re.MULTILINE,
    )


def read_page(app: Sphinx, page: str, source: list[str]) -> None:  # noqa: ARG001
    """Add the navigation to the first page, and the scripts to the gallery."""
    if page == root_doc:
        index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
        source[0] += _contents("Begin", ["docs/index"]) + navigation(index)
        source[0] += _contents("The project", ["CONTRIBUTING", "SECURITY"])
    if page == "docs/gallery/README":
        source[0] = with_scripts(source[0])


def read_docstring(
    app: Sphinx,  # noqa: ARG001
    what: str,  # noqa: ARG001
    name: str,  # noqa: ARG001
    it: object,  # noqa: ARG001
    options: object,  # noqa: ARG001
    lines: list[str],
) -> None:
    """Read a docstring as the Markdown that it is: formulas are blocks, stars are stars."""
    out: list[str] = []
    in_section = in_formula = False
    for line in lines:
        indented = line.startswith(" ")
        if _SECTION.match(line):
            in_section = True
        elif line and not indented:
            in_section = False
        begins = indented and not in_section and not in_formula and out and not out[-1].strip()
        if begins:
            out += ["::", ""]
        in_formula = bool(begins) or (in_formula and (indented or not line))
        out.append(line if in_formula else _plain(line))
    lines[:] = out


def _plain(line: str) -> str:
    """Text outside backticks with the marks of reStructuredText escaped."""
    parts = _LITERAL.split(line)
    return "".join(
        part if part.startswith("`") else re.sub(r"([*|]|_(?=\W|$))", r"\\\1", part)
        for part in parts
    )


def setup(app: Sphinx) -> None:
    """Connect what is read."""
    app.connect("source-read", read_page)
    app.connect("autodoc-process-docstring", read_docstring, priority=400)  # before napoleon
