"""Options and output that commands share."""

import contextlib
import dataclasses
import functools
import inspect
import json
import math
import re
import signal
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin

import typer
from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.segment import Segment
from rich.table import Column, Table
from rich.text import Text

from eitskin import geometry, hardware, training
from eitskin.errors import ConfigurationError, cut
from eitskin.files import visible

if TYPE_CHECKING:
    from eitskin.simulator.electrical.resolution import Discretisation, Resolution
    from eitskin.simulator.simulator import Simulator

MAX_PICTURES = 24  # of one command

_COMMON = "Common"
Seed = Annotated[
    int,
    typer.Option(
        min=0,
        metavar="N",
        rich_help_panel=_COMMON,
        help="Seed of everything random; same seed, same result.",
    ),
]
_UnusedSeed = Annotated[int, typer.Option("--seed", hidden=True)]


_BOARD = typer.Option(
    "--board",
    metavar="URI",
    help="Board: serial: (the only USB port), serial:PORT, text:PORT?protocol=..., virtual: "
    "(simulated) or replay:DIRECTORY. `eitskin ports` lists the ports.",
)
BoardOption = Annotated[str | None, _BOARD]
Specimen = Annotated[int, typer.Option(min=0, help="Number of the specimen in the dataset.")]
Model = Annotated[Path, typer.Argument(metavar="MODEL", help="Trained pipeline, NAME.eitmodel.")]
Replace = Annotated[
    bool, typer.Option("--replace", help="Replace what exists under the name of --out.")
]
MethodCode = Annotated[
    str | None,
    typer.Option(
        "--method",
        metavar="CODE",
        help="Your own method, whose code is run: FILE.py:CLASS, or the name of an installed one.",
    ),
]
FramesPath = Annotated[Path, typer.Argument(help="Folder of the dataset, or one shard.")]
SceneFile = Annotated[
    Path,
    typer.Argument(metavar="SCENE.toml", help="Scene file: bends and touches of the sensor."),
]
SensorFile = Annotated[
    Path | None, typer.Option(help="Sensor design file; the reference sensor if omitted.")
]
MechanicsFile = Annotated[
    Path | None, typer.Option(help="Materials file; gel in Ecoflex if omitted.")
]
FixtureFile = Annotated[
    Path | None, typer.Option(help="Fixture file: the clamp, hinge or arc that bends the sensor.")
]
Pairs = Annotated[
    str, typer.Option(help="Protocol: pairwise, adjacent, opposite, skip:N, FILE.csv.")
]
MeasuredPairs = Annotated[
    str | None,
    typer.Option(
        "--protocol",
        help="Measurements of a frame, in order: pairwise, adjacent, opposite, skip:N or a CSV "
        "file; a name with its number of electrodes, as in adjacent:16.",
    ),
]
Detail = Annotated[
    Literal["coarse", "fast", "standard", "fine"],
    typer.Option(help="Resolution of the electrical model."),
]

VIRTUAL = "virtual:"
TRAINING = "torch sklearn skimage safetensors"  # packages of the extra of that name


def own_method(code: str | None) -> "type[training.Method] | None":
    """Class of the method of the user's own whose code is named; None where none is."""
    from eitskin.training.pipeline.methods import named_method

    return None if code is None else named_method(code)


def with_output(function: Callable[..., None]) -> Callable[..., None]:
    """Command of a function, with --seed, and with the options of each dataclass that it takes.

    Such a dataclass, as `Output`, has a field with a Typer annotation for each of its options.
    """
    signature = inspect.signature(function)
    parameters: dict[str, inspect.Parameter] = {}
    groups: dict[str, tuple[Any, list[str]]] = {}
    for parameter in signature.parameters.values():
        if not dataclasses.is_dataclass(parameter.annotation):
            seed = (parameter.name, parameter.annotation) == ("seed", int)
            parameters[parameter.name] = parameter.replace(annotation=Seed) if seed else parameter
            continue
        members = [
            m for m in dataclasses.fields(parameter.annotation) if get_origin(m.type) is Annotated
        ]
        groups[parameter.name] = parameter.annotation, [member.name for member in members]
        for m in members:
            parameters[m.name] = _keyword(m.name, m.default, m.type)
    if "seed" not in signature.parameters:  # every command takes it, as in version 0.2
        parameters["seed"] = _keyword("seed", 0, _UnusedSeed)
    for parameter in parameters.values():
        if get_origin(parameter.annotation) is Annotated:
            _name_value(parameter)

    @functools.wraps(function)
    def command(*arguments: Any, **options: Any) -> None:
        if "seed" not in signature.parameters:
            options.pop("seed", None)
        for name, (group, members) in groups.items():
            given = {member: options.pop(member) for member in members if member in options}
            options[name] = group(**given)
        function(*arguments, **options)

    command.__signature__ = signature.replace(parameters=tuple(parameters.values()))  # type: ignore[attr-defined]
    command.__annotations__ = {each.name: each.annotation for each in parameters.values()}
    return command


MAX_COUNT = 2**31 - 1
"""Largest value of an option that counts something."""
_VALUES = {int: "N", float: "X", Path: "PATH"}
_STREAMS = "Recording and streams"
_PANELS = {
    "page": "Page",
    "picture": "Page",
    "ros2": "ROS 2",
    **dict.fromkeys(("record", "mcap", "udp", "websocket", "every"), _STREAMS),
}
"""Panels of options by the first word of their names."""


def _name_value(parameter: inspect.Parameter) -> None:
    """Name the value of an option in its help by what it is, and the panel it belongs to."""
    kind, info = get_args(parameter.annotation)
    info.rich_help_panel = info.rich_help_panel or _PANELS.get(parameter.name.partition("_")[0])
    plain = next((each for each in (get_args(kind) or (kind,)) if each is not type(None)), kind)
    if plain is int and info.min is not None and info.max is None:
        info.max = MAX_COUNT
    flag = plain is bool or get_origin(kind) is Literal or get_origin(plain) is Literal
    if info.metavar is None and not flag and not isinstance(plain, str):
        named = parameter.name.rpartition("_")[2].upper()
        argument = isinstance(info, typer.models.ArgumentInfo)
        info.metavar = named if argument else _VALUES.get(plain, named)


def _keyword(name: str, default: Any, annotation: Any) -> inspect.Parameter:
    kind = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(name, kind, default=default, annotation=annotation)


@dataclass(frozen=True)
class SensorOptions:
    """Options of a simulated sensor: design, materials, fixture, model of touches, protocol."""

    sensor: SensorFile = None
    mechanics: MechanicsFile = None
    fixture: FixtureFile = None
    touch_model: Annotated[
        Literal["tabulated", "solved"] | None,
        typer.Option(help="Model of touches; tabulated where tables exist, if omitted."),
    ] = None
    protocol: Pairs = "pairwise"

    def simulator(
        self,
        resolution: "Resolution | Discretisation",
        design: "geometry.SensorDesign | None" = None,
    ) -> "Simulator":
        """Simulator of the sensor; raises ConfigurationError for options or files that do not fit.

        The design is that of --sensor, unless another is given.
        """
        from eitskin.protocol import Protocol
        from eitskin.simulator.deformation.sensor_grid import read_fixed
        from eitskin.simulator.simulator import Simulator

        design = design or read_design(self.sensor)
        fixture, mechanics, grid = read_fixed(self.fixture, self.mechanics)
        pairs = Protocol.from_name(self.protocol, len(design.electrodes))
        return Simulator(design, resolution, fixture, pairs, mechanics, self.touch_model, grid=grid)


def read_design(sensor: Path | None) -> "geometry.SensorDesign":
    """Design of a file, or the reference sensor where none is named."""
    return geometry.SensorDesign.from_toml(sensor) if sensor else geometry.SensorDesign.reference()


def require_parent(out: Path) -> None:
    """Raise ConfigurationError for a file whose folder is missing, before anything is computed."""
    if not out.absolute().parent.is_dir():
        raise ConfigurationError(
            f"cannot write {out}: there is no folder {out.parent}; make it, or name another"
        )


def electrode_pair(drive: str, electrodes: int) -> tuple[int, int]:
    """Two electrodes of the option --drive, as 0-4 or 0,4; raises ConfigurationError."""
    match = re.fullmatch(r"\s*(\d{1,6})\s*[-,]\s*(\d{1,6})\s*", drive)
    pair = (int(match[1]), int(match[2])) if match else (0, 0)
    if pair[0] == pair[1] or max(pair) >= electrodes:
        raise ConfigurationError(
            f"--drive takes two different electrodes from 0 to {electrodes - 1}, as 0-4, got "
            f"'{drive}'"
        )
    return pair


def named_board(uri: str | None) -> str:
    """URI of the board that is named; raises ConfigurationError with the choices where none is."""
    if uri is None:
        from eitskin.hardware.boards.port import serial_ports

        ports = [port.uri for port in serial_ports()]
        raise ConfigurationError(
            "no board is named\nexpected --board with a serial port of this machine "
            f"({', '.join(ports) or 'none found'}), or --board {VIRTUAL} for a simulated sensor"
        )
    return uri


def opened_board(
    uri: str, seed: int, layout: "training.InputSpec | None" = None
) -> "hardware.Board":
    """Board of a URI, open.

    A virtual one has the seed, and the sensor and measurements of a pipeline's layout, except for
    what its URI says.
    """
    given: dict[str, Any] = {}
    if uri.startswith(VIRTUAL):
        given |= {} if "seed=" in uri else {"seed": seed}
        is_described = "sensor=" in uri or "protocol=" in uri
        if layout is not None and layout.known_design is not None and not is_described:
            given |= {"sensor": layout.known_design, "protocol": layout.known_protocol}
    return hardware.open_board(uri, **given)


@contextlib.contextmanager
def ended_by_signals() -> Iterator[None]:
    """Context in which SIGTERM acts as Ctrl-C, so that open files are closed and kept.

    A KeyboardInterrupt that struck compiled code, which reports it as the cause of a SystemError,
    is raised as a KeyboardInterrupt.
    """

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    except SystemError as error:
        if not _was_interrupted(error):
            raise
        raise KeyboardInterrupt from error
    finally:
        signal.signal(signal.SIGTERM, before)


def _was_interrupted(error: BaseException | None) -> bool:
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__
    return error is not None


def _finite(data: Any) -> Any:
    """Data with None for every number that JSON has not."""
    if isinstance(data, float):
        return data if math.isfinite(data) else None
    if isinstance(data, Mapping):
        return {key: _finite(value) for key, value in data.items()}
    if isinstance(data, (list, tuple)):
        return [_finite(value) for value in data]
    return data


class Terminal(Console):
    """Console on which no text of a file, a board or a pipeline acts as a command.

    It shows control characters of what it prints; colours are its own.
    """

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Segments of what is printed, in which all text is printable."""
        for segment in super().render(renderable, options):
            if segment.control or segment.text.isprintable():
                yield segment
            else:
                yield Segment(visible(segment.text), segment.style)

    def render_str(self, text: str, **options: Any) -> Text:
        """Text of a string, as wide as it is shown."""
        return super().render_str(visible(text), **options)


def make_table(
    headings: Iterable[str | Column], rows: Iterable[Sequence[str]], **look: Any
) -> Table:
    """Table of rows of cells, with options of Rich's `Table`."""
    table = Table(*headings, **look)
    for cells in rows:
        table.add_row(*cells)
    return table


@dataclass
class Output:
    """Output of a command: the result on stdout, everything else on stderr."""

    as_json: Annotated[
        bool, typer.Option("--json", rich_help_panel=_COMMON, help="Print the result as JSON.")
    ] = False
    quiet: Annotated[
        bool,
        typer.Option("--quiet", "-q", rich_help_panel=_COMMON, help="Print only the result."),
    ] = False
    verbose: Annotated[
        bool,
        typer.Option("--verbose", "-v", rich_help_panel=_COMMON, help="Print more about the work."),
    ] = False
    console: Console = field(default_factory=Terminal)
    notes: Console = field(default_factory=lambda: Terminal(stderr=True))

    def result(self, data: Mapping[str, Any], shown: RenderableType) -> None:
        """Print the result: `data` with --json, else `shown`."""
        if self.as_json:
            self.console.print_json(json.dumps(_finite(data), allow_nan=False), ensure_ascii=True)
        elif isinstance(shown, str):  # without line breaks, which would cut a path
            self.console.print(shown, soft_wrap=True, markup=False)
        else:
            self.console.print(shown)

    def heading(self, text: str) -> None:
        """Print a heading of a long command; left out with --json."""
        if not self.as_json:
            self.console.print(f"\n[bold]{text}[/bold]", highlight=False)

    def show(self, shown: RenderableType) -> None:
        """Print a part of the result; left out with --json, whose one object holds the part."""
        if not self.as_json:
            self.console.print(shown, highlight=False)

    def note(self, text: str, *, whole: bool = False) -> None:
        """Print a note on stderr, unless quiet; `whole` without line breaks, to be copied."""
        if not self.quiet:
            self.notes.print(cut(text), highlight=False, markup=False, soft_wrap=whole)

    def detail(self, text: str) -> None:
        """Print a note on stderr with --verbose."""
        if self.verbose and not self.quiet:
            self.notes.print(text, style="dim", highlight=False, markup=False)

    @contextlib.contextmanager
    def bars(self) -> Iterator[Callable[..., Any]]:
        """Progress bars on stderr with count and time left; silent when quiet.

        The context is a function that is given the name of a bar, how many are done, of how many
        (None where that is not known), and perhaps a text next to them; it makes a bar for each new
        name, and returns the speed [1/s].
        """
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=self.notes, disable=self.quiet) as progress:
            bars: dict[str, TaskID] = {}

            def show(name: str, done: int, total: int | None, rate: str = "") -> float | None:
                if name not in bars:
                    bars[name] = progress.add_task(name, total=total, rate="")
                progress.update(bars[name], completed=done, total=total, rate=rate)
                return progress.tasks[bars[name]].speed

            yield show

    @contextlib.contextmanager
    def counting(self, text: str) -> Iterator[Callable[..., Any]]:
        """Progress bar, as a function that is given how many are done, and of how many."""
        with self.bars() as show:
            yield functools.partial(show, text)


def frame_numbers(text: str, count: int) -> list[int]:
    """Frame numbers of a text such as 0,5,10-12.

    Raises ConfigurationError for other text, and numbers that are not among `count` frames.
    """
    try:
        parts = [[int(end) for end in part.split("-")] for part in text.split(",")]
        chosen = [k for part in parts for k in range(part[0], part[-1] + 1)]
    except ValueError as error:
        raise ConfigurationError(f"expected frames as 0,5,10-12, got '{text}'") from error
    if not chosen or min(chosen) < 0 or max(chosen) >= count or len(chosen) > MAX_PICTURES:
        raise ConfigurationError(
            f"expected up to {MAX_PICTURES} frames from 0 to {count - 1}, got '{text}'"
        )
    return chosen


def given_words(context: typer.Context, leave: Container[str]) -> list[str]:
    """Words of the command that runs, without the parameters called `leave`."""
    words = [context.info_name or ""]
    for parameter in context.command.params:
        value = context.params.get(parameter.name or "")
        source = context.get_parameter_source(parameter.name or "")
        if parameter.name in leave or source is None or source.name != "COMMANDLINE":
            continue
        option = [] if parameter.param_type_name == "argument" else parameter.opts[:1]
        for each in value if isinstance(value, list | tuple) else [value]:
            words += option if each is True else [*option, str(each)]
    return words


def progress_watcher(output: Output) -> Callable[[str, Sequence[Any]], Iterable[Any]]:
    """Progress bar around the items of a benchmark."""

    def watch(text: str, items: Sequence[Any]) -> Iterable[Any]:
        with output.counting(text) as show:
            for done, item in enumerate(items):
                show(done, len(items), str(getattr(item, "family", "")))
                yield item
            show(len(items), len(items))

    return watch
