"""Commands with plain help: options in named groups, examples, and old spellings that still work.

Help is text without boxes, the same on a terminal and in a pipe.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

RENAMED_COMMANDS: Mapping[tuple[str, ...], tuple[str, ...]] = {
    ("board",): ("virtual-board",),
    ("instrument", "fit"): ("fit", "instrument"),
    ("twin", "fit"): ("fit", "twin"),
    ("help",): ("--help",),
    ("version",): ("--version",),
}
"""Old first words of a command line, and those that take their place."""

EXAMPLES = """
eitskin demo
eitskin demo --out build/demo --data recordings
eitskin live reference.eitmodel --board virtual: --page
eitskin live mine.eitmodel --board serial: --record monday --ros2
eitskin simulate scene.toml --view scene.png
eitskin simulate scene.toml --sensor sheet.toml --protocol adjacent --json
eitskin generate training --out data --dry-run
eitskin generate my-recipe.toml --out data --workers 8
eitskin import log.csv --out mine --values ch --protocol adjacent:16
eitskin import log.csv --out mine --sensor sheet.toml --protocol pairwise --length-unit mm
eitskin dataset info data
eitskin dataset info data --json
eitskin dataset verify data
eitskin dataset verify data --workers 4
eitskin dataset compact data --out large
eitskin dataset compact data --out large --frames-per-shard 65536
eitskin dataset combine simulated mine --out both
eitskin dataset combine monday tuesday --out week --magnitudes
eitskin export parquet data --out parquet
eitskin export parquet data --out parquet --license cc-by-4.0
eitskin export huggingface data --out hub
eitskin export huggingface data --out hub --license cc-by-4.0
eitskin export lerobot series --out lerobot
eitskin export lerobot series --out lerobot --license cc-by-4.0
eitskin export mcap monday --out monday.mcap
eitskin export mcap monday --model reference.eitmodel --out monday.mcap
eitskin export vtu scene.toml --out fields
eitskin export vtu scene.toml --out fields --drive 0-4
eitskin train data --out mine.eitmodel
eitskin train data --out mine.eitmodel --preset ridge --report report
eitskin evaluate mine.eitmodel test-data
eitskin evaluate mine.eitmodel test-data --out report
eitskin adapt reference.eitmodel recording --out mine.eitmodel
eitskin adapt none recording --out positions.eitmodel
eitskin calibrate reference.eitmodel --board serial: --out mine.eitmodel
eitskin calibrate reference.eitmodel --board virtual: --no-prompt --out mine.eitmodel
eitskin ports
eitskin ports --json
eitskin check reference.eitmodel --board serial:
eitskin check --recording monday
eitskin tare reference.eitmodel --board serial: --out flat.json
eitskin tare reference.eitmodel --dataset monday --out flat.json
eitskin setup reference.eitmodel --board serial: --out mine.eitmodel
eitskin setup none --sensor sheet.toml --board serial: --out mine.eitmodel
eitskin virtual-board --link /tmp/skin
eitskin virtual-board --scene scene.toml --faults unplug@100
eitskin reconstruct recording --sensor sheet.toml --frames 30 --out image.png
eitskin reconstruct serial: --sensor sheet.toml --page
eitskin mesh --sensor sheet.toml --view sheet.png
eitskin mesh --view current.png --drive 0-4
eitskin fit instrument sensor.toml recording --out rig.toml
eitskin fit instrument sensor.toml recording --out rig.toml --first 400
eitskin fit twin design.toml recording --out twin
eitskin fit twin design.toml recording --out twin --terms sink,idle --first 400
eitskin bench accuracy
eitskin bench accuracy --out results --quick
eitskin bench stability
eitskin bench stability --out results --quick
eitskin bench world
eitskin bench world --out results --quick
eitskin bench speed
eitskin bench speed --out results --quick
eitskin bench recordings recordings
eitskin bench recordings recordings --quick
eitskin bench tank KTC2023
eitskin bench tank KTC2023 --quick
eitskin bench transfer
eitskin bench transfer mine.eitmodel --quick
eitskin bench life
eitskin bench life mine.eitmodel --hours 0.1
eitskin bench methods --preset ridge --preset mlp
eitskin bench methods --method my.py:Net --quick
eitskin bench paper
eitskin bench paper --pipeline mine.eitmodel --seeds 1
eitskin bench layouts --sweep count
eitskin bench layouts --quick --workers 8
eitskin bench all
eitskin bench all --only speed --only accuracy --quick
"""


def command_examples(path: str) -> list[str]:
    """Examples of the command with this path, such as "eitskin dataset info"."""
    return [line for line in EXAMPLES.splitlines() if f"{line} ".startswith(f"{path} ")]


class Command(TyperCommand):
    """Command whose help has examples, and options by their panels."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write examples, arguments and options, each group below its title."""
        examples = command_examples(ctx.command_path)
        if examples:
            with formatter.section("Examples"):
                for line in examples:
                    formatter.write(f"{'':{formatter.current_indent}}{line}\n")
        groups: dict[str, list[tuple[str, str]]] = {}
        for get_param in self.get_params(ctx):
            record = get_param.get_help_record(ctx)
            kind = "Arguments" if get_param.param_type_name == "argument" else "Options"
            title = getattr(get_param, "rich_help_panel", None) or kind
            if get_param.name == "help":
                title = "Common"
            if record is not None:
                groups.setdefault(title, []).append(record)
        groups |= {title: groups.pop(title) for title in ("Common",) if title in groups}
        for title, records in groups.items():
            with formatter.section(title):
                formatter.write_dl(records)


class Commands(TyperGroup):
    """Group whose help lists its commands by their panels."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ARG002
        """Write the commands, each group below its title."""
        groups: dict[str, list[tuple[str, str]]] = {}
        for name, command in self.commands.items():
            if not command.hidden:
                title = getattr(command, "rich_help_panel", None) or "Commands"
                first = re.split(r"[;:.](?:\s|$)", command.help or "")[0]
                groups.setdefault(title, []).append((name, " ".join(first.split())))
        for title, rows in groups.items():
            with formatter.section(title):
                formatter.write_dl(rows)


def with_new_spelling(words: Sequence[str]) -> list[str]:
    """Command line in today's spelling; a line on stderr says what replaces an old one."""
    old, new = list(words), list(words)
    for before, after in RENAMED_COMMANDS.items():
        if tuple(new[: len(before)]) == before:
            arguments = new[len(before) :]
            new = [*arguments, *after] if after == ("--help",) else [*after, *arguments]
            break
    if new[:2] == ["dataset", "export"]:
        new, form = new[2:], "parquet"
        if "--format" in new[:-1]:
            place = new.index("--format")
            form = new[place + 1]
            del new[place : place + 2]
        new = ["export", form, *new]
    if new[:1] == ["check"] and "--list" in new:
        new = ["ports", *(word for word in new[1:] if word != "--list")]
    if new[:2] == ["export", "vtu"] and "--drive" in new[:-2]:
        place = new.index("--drive")
        if new[place + 1].isdigit() and new[place + 2].isdigit():
            new[place + 1 : place + 3] = [f"{new[place + 1]}-{new[place + 2]}"]
    new = ["--color" if word == "--colour" else word for word in new]
    if new != old and old[0] not in ("help", "version"):
        typer.echo(f"eitskin: this is now `eitskin {' '.join(new[:2])}`", err=True)
    return new
