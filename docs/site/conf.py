"""The site: the project's own Markdown, the gallery's scripts and the reference; `make docs`."""

import base64
import importlib
import inspect
import json
import re
import shutil
from pathlib import Path

from sphinx.application import Sphinx

import eitskin

ROOT = Path(__file__).resolve().parents[2]
API = ROOT / "docs" / "site" / "api"
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
    "docs/site/api/*.rst",
    "docs/site/api/*.markdown",
    "hardware/firmware/README.md",
    "hardware/firmware/nucleo_f411/README.md",
]
source_suffix = {".rst": "restructuredtext", ".md": "markdown", ".markdown": "markdown"}
exclude_patterns = [
    *(f"{path.name}" for path in ROOT.iterdir() if path.is_dir() and path.name[0] == "."),
    *("benchmarks", "build", "cli", "datasets", "eitskin", "geometry", "simulator", "tests"),
    *("training", "docs/site/extra"),
]

myst_heading_anchors = 4
highlight_language = "text"
suppress_warnings = ["misc.highlighting_failure"]  # examples with "..." in them
nitpicky = False
smartquotes = False  # options keep their two dashes

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
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}
napoleon_use_ivar = True
default_role = "literal"  # single backticks, as in the Markdown

_SECTION = re.compile(r"^(Args|Attributes|Raises|Returns|Yields|Examples?|Notes?):$")
_LITERAL = re.compile(r"(`[^`]*`)")


def write_api() -> None:
    """Write the pages of the Python API: a table for each package, a page for each public name."""
    shutil.rmtree(API, ignore_errors=True)
    API.mkdir()
    for room in ROOMS:
        module = importlib.import_module(f"eitskin.{room}")
        rows = []
        for name in sorted(module.__all__):
            thing = getattr(module, name)
            kind = "class" if inspect.isclass(thing) else "function"
            if kind == "function" and not inspect.isfunction(thing):
                kind = "data"
            first = (inspect.getdoc(thing) or "").partition("\n")[0] if kind != "data" else ""
            rows.append(f"   * - :doc:`{name} <{room}.{name}>`\n     - {_plain(first)}\n")
            title = f"eitskin.{room}.{name}"
            directive = f".. auto{kind}:: {title}\n"
            (API / f"{room}.{name}.rst").write_text(
                f":orphan:\n\n{title}\n{'=' * len(title)}\n\n{directive}", encoding="utf-8"
            )
        title = f"eitskin.{room}"
        table = ".. list-table::\n   :widths: 30 70\n\n" + "".join(rows)
        (API / f"{room}.rst").write_text(
            f"{title}\n{'=' * len(title)}\n\n{table}", encoding="utf-8"
        )


def write_notebooks() -> None:
    """Write the notebooks as pages: their text, code, printed lines and figures."""
    for path in sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")):
        parts = []
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            source = "".join(cell["source"])
            if cell["cell_type"] == "markdown":
                parts.append(source.replace("](../", "](../../"))
                continue
            parts.append(f"```python\n{source}\n```")
            for output in cell["outputs"]:
                if output["output_type"] == "stream":
                    parts.append(f"```text\n{''.join(output['text'])}```")
                    continue
                image = API / f"{path.stem}-{len(parts)}.png"
                image.write_bytes(base64.b64decode(output["data"]["image/png"]))
                parts.append(f"![figure of the cell above]({image.name})")
        (API / f"{path.stem}.markdown").write_text("\n\n".join(parts), encoding="utf-8")


def navigation() -> str:
    """Hidden tables of contents: the sections of the pages, each in the order of the map."""
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    parts = []
    for section in re.split(r"^## ", index, flags=re.MULTILINE)[1:]:
        caption, _, body = section.partition("\n")
        pages = [f"docs/{each}" for each in re.findall(r"\]\(((?!\.\.)[^)#\s]+)\.md\)", body)]
        parts.append(_contents(caption, list(dict.fromkeys(pages))))
    results = sorted(path.stem for path in (ROOT / "docs" / "results").glob("*.md"))
    parts.append(_contents("Measured", [f"docs/results/{name}" for name in results]))
    notebooks = sorted(path.stem for path in (ROOT / "docs" / "notebooks").glob("*.ipynb"))
    parts.append(_contents("Notebooks", [f"docs/site/api/{name}" for name in notebooks]))
    parts.append(_contents("Python API", [f"docs/site/api/{room}" for room in ROOMS]))
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
        source[0] += _contents("Begin", ["docs/index"]) + navigation()
        project = ["CHANGELOG", "CONTRIBUTING", "SECURITY"]
        project += ["hardware/firmware/README", "hardware/firmware/nucleo_f411/README"]
        source[0] += _contents("The project", project)
    if page == "docs/index":
        source[0] = re.sub(r"\(notebooks/(\w+)\.ipynb\)", r"(site/api/\1.markdown)", source[0])
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
    """Text outside backticks with the marks of reStructuredText escaped; examples as they are."""
    if line.lstrip().startswith((">>>", "...")):
        return line
    parts = _LITERAL.split(line)
    return "".join(
        part if part.startswith("`") else re.sub(r"([*|]|_(?=\W|$))", r"\\\1", part)
        for part in parts
    )


def setup(app: Sphinx) -> None:
    """Write the pages of the API and of notebooks, and connect what is read."""
    write_api()
    write_notebooks()
    app.connect("source-read", read_page)
    app.connect("autodoc-process-docstring", read_docstring, priority=400)  # before napoleon
