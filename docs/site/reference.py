"""Reference pages made from the code: commands and keys of files; `make pages`."""

import dataclasses
import inspect
import itertools
import re
import types
import typing
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

import typer

from eitskin.cli.help import command_examples
from eitskin.cli.main import app
from eitskin.datasets import Recipe
from eitskin.geometry import Clamp, FreeArc, Hinge, SensorDesign
from eitskin.geometry.design import regular_layouts
from eitskin.hardware import Script
from eitskin.protocol import Protocol
from eitskin.simulator import Instrument, Mechanics, Scene, SensorGrid
from eitskin.training import TwinPrior

REFERENCE = Path(__file__).resolve().parents[1] / "reference"
FILES = {
    "Sensor designs": ("DESIGN.toml, `--sensor`", [SensorDesign]),
    "Layouts of electrodes": (
        "`electrodes` of a design, instead of a list",
        [regular_layouts.uniform, regular_layouts.grid],
    ),
    "Scenes": ("SCENE.toml", [Scene]),
    "Scripts of scenes": ("`virtual:?scene=FILE.toml`", [Script]),
    "Fixtures": ("FIXTURE.toml, `--fixture`", [Clamp, Hinge, FreeArc]),
    "Materials": ("MECHANICS.toml, `--mechanics`", [Mechanics]),
    "Instruments": ("RIG.toml, `--instrument`", [Instrument]),
    "Recipes": ("RECIPE.toml, `eitskin generate`", [Recipe]),
    "Priors of a twin": ("PRIOR.toml, `fit twin --prior`", [TwinPrior]),
}
SIMPLE = {float: "number", int: "integer", str: "text", bool: "true or false", Path: "path"}
SIMPLE |= {complex: "complex", Protocol: "name or path"}
UNLISTED = (Protocol, SensorGrid)
COMMON = 2  # commands that take an option, for it to be described once


def files_page() -> str:
    """Markdown of the keys of all files."""
    parts = [
        "# Files\n\nKeys of every TOML file, generated from the code. Units are SI. "
        "All keys but those marked as required may be left out; a value in brackets is the "
        "default. Unknown keys are refused with a suggestion. A complex value is a number or "
        "`[real, imaginary]`. Paths are relative to the file that names them. If a key takes one "
        "of several tables, the keys in it decide which.\n"
    ]
    shown: set[object] = set()
    described: dict[str, str] = {}
    for title, (where, kinds) in FILES.items():
        parts.append(f"## {title}\n\n{where}.\n")
        queue = list(kinds)
        for kind in queue:
            if kind in shown:
                continue
            shown.add(kind)
            rows = list(_keys(kind))
            queue += [inner for _, annotation, _, _ in rows for inner in _tables(annotation)]
            parts.append(_keys_table(kind, rows, described))
    return "\n".join(parts)


def commands_page() -> str:
    """Markdown of all commands: what each does, examples, options; common options once."""
    group = typer.main.get_command(app)
    commands = list(_commands("eitskin", group))
    counts = Counter(row for _, _, command in commands for row in _rows(command))
    frequent = [row for row, count in reversed(counts.most_common()) if count >= COMMON]
    common = set({row.split()[1].strip("`:"): row for row in frequent}.values())
    parts = [
        "# Commands\n\nGenerated from the code; the help of each command (`-h`) shows the "
        "same. All commands take `--json`, `--quiet` and `--verbose`.\n\n## Common options\n\n"
        "If a command lists such an option, its own meaning holds.\n\n"
        f"{chr(10).join(sorted(common))}\n"
    ]
    panel = ""
    for path, top, command in commands:
        if top != panel:
            parts.append(f"## {(panel := top)}\n")
        rows = list(_rows(command))
        own = [row for row in rows if row not in common]
        shared = ", ".join(row.split("`")[1].split()[0] for row in rows if row in common)
        text = inspect.cleandoc(command.help or "")
        parts.append(f"### {path}\n\n{text}\n")
        if examples := _page_examples(command_examples(path), path, shared):
            parts.append("```bash\n" + "\n".join(examples) + "\n```\n")
        if own:
            parts.append("\n".join(own) + "\n")
        if shared:
            parts.append(f"Common: `{shared}`.\n")
    return "\n".join(parts)


def _commands(
    path: str, group: typing.Any, panel: str = ""
) -> Iterator[tuple[str, str, typing.Any]]:
    """Path, panel and command of each command, panel by panel."""
    members = [(n, c) for n, c in group.commands.items() if not c.hidden]
    if not panel:
        order = list(dict.fromkeys(c.rich_help_panel or "Commands" for _, c in members))
        members.sort(key=lambda member: order.index(member[1].rich_help_panel or "Commands"))
    for name, command in members:
        top = panel or command.rich_help_panel or "Commands"
        if hasattr(command, "commands"):
            yield from _commands(f"{path} {name}", command, top)
        else:
            yield f"{path} {name}", top, command


def _page_examples(examples: Iterable[str], path: str, shared: str) -> list[str]:
    """Examples that show more than common options, and more than the others."""
    kept: dict[str, tuple[list[str], set[str]]] = {}
    for example in examples:
        pairs = list(itertools.pairwise(["", *example.removeprefix(path).split()]))
        options = {word for _, word in pairs if word.startswith("-")}
        values = [b for a, b in pairs if not a.startswith("-") and not b.startswith("-")]
        if values or not options <= set(shared.split(", ")):
            kept[example] = (values, options)
    return [
        example
        for example, (values, options) in kept.items()
        if not any(values == v and options < o for v, o in kept.values())
    ]


def _rows(command: typing.Any) -> Iterator[str]:
    """Items of the list of a command's arguments and options."""
    for each in command.params:
        name = usage_name(each)
        if name in ("`--json`", "`--quiet`", "`--verbose`", "`--help`") or each.hidden:
            continue
        note = f" Default: {each.default}." if each.default not in (None, False, "", ()) else ""
        yield f"- {name}: {' '.join((each.help or '').split())}{note}"


def usage_name(parameter: typing.Any) -> str:
    """Option or argument as it is typed, with the kind of its value."""
    if parameter.param_type_name == "argument":
        return f"`{(parameter.metavar or parameter.name).upper()}`"
    flag = parameter.opts[0]
    return f"`{flag}`" if parameter.is_flag else f"`{flag} {_metavar(parameter)}`"


def _metavar(parameter: typing.Any) -> str:
    annotation = parameter.type_descriptor.annotation
    if typing.get_origin(annotation) is typing.Literal:
        return "|".join(typing.get_args(annotation))
    return parameter.metavar or parameter.name.upper()


def _keys(kind: typing.Any) -> Iterator[tuple[str, typing.Any, str, str]]:
    """Name, type, default and description of each key."""
    described = _described(inspect.getdoc(kind) or "")
    hints = typing.get_type_hints(kind)
    if dataclasses.is_dataclass(kind):
        for field in dataclasses.fields(kind):
            default = _default(field.default)
            if field.default_factory is not dataclasses.MISSING:
                default = ""
            text = described.get(field.name, "")
            for base in kind.__mro__[1:]:  # a property that the field implements
                if not text and field.name in vars(base):
                    text = inspect.getdoc(vars(base)[field.name]) or ""
            yield field.name, hints[field.name], default, text
        return
    for name, parameter in inspect.signature(kind).parameters.items():
        if name != "outline":
            yield name, hints[name], _default(parameter.default), described.get(name, "")


def _keys_table(
    kind: typing.Any, rows: list[tuple[str, typing.Any, str, str]], shown: dict[str, str]
) -> str:
    """Section of a table's keys; `shown` has the table of each row that came before."""
    first, *rest = (inspect.getdoc(kind) or "").split("\n\n")
    lines = [f"### {kind.__name__}", "", " ".join(first.split()), ""]
    if not rows:
        return "\n".join([*lines[:-1], f' Written as `"{kind.__name__.lower()}"`.', ""])
    sections = ("Args", "Attributes", "Raises", "Example", "Returns")
    if rest and rest[0].endswith(".") and not rest[0].startswith((*sections, " ")):
        lines += [" ".join(rest[0].split()), ""]
    described = [(_key_facts(*row[1:]), row[0]) for row in rows]
    earlier: dict[str, list[str]] = {}
    for item, alike in itertools.groupby(described, lambda row: row[0]):
        names = ", ".join(f"`{name}`" for _, name in alike)
        first_table = shown.setdefault(line := f"- {names} {item}", kind.__name__)
        if first_table == kind.__name__:
            lines.append(line)
        else:
            earlier.setdefault(first_table, []).append(names)
    for table, keys in earlier.items():
        lines.append(f"- {', '.join(keys)}: as in [{table}](#{table.lower()})")
    return "\n".join([*lines, ""])


def _key_facts(hint: typing.Any, default: str, text: str) -> str:
    """Type, unless the default shows it, default, and description of a key."""
    if not default.startswith("`"):
        facts = f"({_type(hint)}{default})"
    elif (hint in SIMPLE and hint is not complex) or typing.get_origin(hint) is tuple:
        facts = f"({default})"
    else:
        facts = f"({_type(hint)}, default {default})"
    return f"{facts}: {text}".removesuffix(": ")


def _described(docstring: str) -> dict[str, str]:
    """Descriptions in the section of attributes or arguments, by name."""
    section = re.search(r"^(?:Attributes|Args):\n((?:(?: {4}.*)?\n?)+)", docstring, re.MULTILINE)
    found: dict[str, str] = {}
    for names, text in re.findall(
        r"^ {4}(\w+(?:, \w+)*): (.*(?:\n {8}.*)*)", section[1] if section else "", re.MULTILINE
    ):
        found |= dict.fromkeys(names.split(", "), " ".join(text.split()))
    return found


def _type(annotation: typing.Any) -> str:  # noqa: PLR0911  one for each kind
    origin, members = typing.get_origin(annotation), typing.get_args(annotation)
    if annotation in SIMPLE:
        return SIMPLE[annotation]
    if origin is typing.Literal:
        return "`" + "|".join(f'"{each}"' for each in members) + "`"
    if origin in (typing.Union, types.UnionType):
        *firsts, last = (_type(each) for each in members if each is not types.NoneType)
        return f"{', '.join(firsts)} or {last}" if firsts else last
    if origin is tuple and members[-1] is Ellipsis:
        return f"list of {_type(members[0])}"
    if origin is tuple:
        return "[" + ", ".join(_type(each) for each in members) + "]"
    if dataclasses.is_dataclass(annotation) and annotation not in UNLISTED:
        return f"[{annotation.__name__}](#{annotation.__name__.lower()})"
    return getattr(annotation, "__name__", str(annotation))


def _tables(annotation: typing.Any) -> list[typing.Any]:
    """Dataclasses in an annotation that have a table of their own."""
    if dataclasses.is_dataclass(annotation):
        return [] if annotation in UNLISTED else [annotation]
    return [kind for each in typing.get_args(annotation) for kind in _tables(each)]


def _default(value: object) -> str:
    if value in (dataclasses.MISSING, inspect.Parameter.empty):
        return ", required"
    if value is None or value in ((), "") or dataclasses.is_dataclass(value):
        return ""
    return f"`{_toml(value)}`"


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "[" + ", ".join(_toml(each) for each in value) + "]"
    return f'"{value}"' if isinstance(value, str) else str(value)


PAGES = {"files.md": files_page, "commands.md": commands_page}

if __name__ == "__main__":
    for name, page in PAGES.items():
        (REFERENCE / name).write_text(page(), encoding="utf-8")
