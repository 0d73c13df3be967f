"""One HTML page that needs nothing else: no script, no style sheet, no picture of its own."""

import base64
import string
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib import resources
from typing import Any

from eitskin.cli.demo.parts import Part, Picture


class _Numbers(string.Formatter):
    """Fills "{stage.key.key:format}" with a number of the document, and says which one it is."""

    def get_field(
        self,
        field_name: str,
        args: Sequence[Any],  # noqa: ARG002  the formatter's interface
        kwargs: Mapping[str, Any],
    ) -> tuple[Any, str]:
        """The value and the path of a field."""
        value: Any = kwargs
        for key in field_name.split("."):
            value = value[int(key)] if isinstance(value, list) else value[key]
        return (value, field_name), field_name

    def format_field(self, value: Any, format_spec: str) -> str:
        """A number, marked with where it stands in report.json."""
        number, path = value
        shown = "none" if number is None else format(number, format_spec)
        exact = escape(str(number))
        return f'<data value="{exact}" data-from="{escape(path)}">{escape(shown)}</data>'


def filled(template: str, document: Mapping[str, Any]) -> str:
    """HTML of `template`, whose text is taken as it is, with numbers of `document` put in."""
    return _Numbers().vformat(template, (), document)


def paragraph(html: str, kind: str = "") -> str:
    """A paragraph of HTML; `kind` is its class."""
    return f'<p class="{kind}">{html}</p>' if kind else f"<p>{html}</p>"


def figure(picture: Picture, kind: str = "") -> str:
    """A picture with its caption; one that is wide can be moved sideways on a phone."""
    data = base64.b64encode(picture.data).decode()
    wide = "wide" if picture.width > 6.5 else "narrow"
    source = f"data:{picture.media};base64,{data}"
    return (
        f'<figure class="{wide} {kind}"><div class="picture"><img alt="{escape(picture.alt)}" '
        f'style="--width: {picture.width:g}in" src="{source}"></div>'
        f"<figcaption>{escape(picture.caption)}</figcaption></figure>"
    )


def figures(part: Part, *names: str) -> str:
    """Those pictures of a part that it has, in the order of `names`."""
    return "\n".join(figure(part.pictures[name]) for name in names if name in part.pictures)


def table(
    headings: Sequence[str], rows: Iterable[Sequence[str]], caption: str, as_html: bool = False
) -> str:
    """A table with a caption, all of it text unless its cells are given `as_html`."""
    keep = str if as_html else escape
    head = "".join(f'<th scope="col">{escape(each)}</th>' for each in headings)
    body = "".join(
        "<tr>"
        + f'<th scope="row"{_indent(first)}>{escape(first.strip())}</th>'
        + "".join(f"<td>{keep(cell)}</td>" for cell in rest)
        + "</tr>\n"
        for first, *rest in rows
    )
    return (
        f'<figure class="table"><div class="picture"><table><thead><tr>{head}</tr></thead>\n'
        f"<tbody>{body}</tbody></table></div><figcaption>{escape(caption)}</figcaption></figure>"
    )


def _indent(text: str) -> str:
    return ' class="of"' if text.startswith(" ") else ""


def section(name: str, heading: str, *content: str) -> str:
    """A section that can be pointed at by its name."""
    inside = "\n".join(content)
    return f'<section id="{name}">\n<h2>{escape(heading)}</h2>\n{inside}\n</section>'


def page(title: str, content: Iterable[str]) -> str:
    """The whole page, with its style inside."""
    style = (resources.files("eitskin.cli.demo") / "report.css").read_text(encoding="utf-8")
    body = "\n".join(content)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{style}</style>\n</head>\n"
        f"<body>\n{body}\n</body>\n</html>\n"
    )
