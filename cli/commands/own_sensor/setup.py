"""`eitskin setup`: a new sensor at a board, step by step, to a pipeline of its own."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from eitskin.cli.commands import check, tare
from eitskin.cli.commands.live import seeded
from eitskin.cli.commands.own_sensor.adapt import StartModel, adapt, in_words, open_start, said
from eitskin.cli.commands.own_sensor.calibrate import Angles, angles_of
from eitskin.cli.commands.own_sensor.poses import (
    as_dataset,
    asked,
    bent,
    frames_in_poses,
    place_map,
    press_places,
    pressed,
    staged,
)
from eitskin.cli.options import BoardOption, Json, Output, Quiet, Seed, SensorFile, Verbose
from eitskin.errors import ConfigurationError, EitskinError

if TYPE_CHECKING:
    from eitskin.cli.commands.own_sensor.poses import Pose
    from eitskin.frame import Frame
    from eitskin.geometry.design.sensor import SensorDesign
    from eitskin.hardware.boards.board import Board
    from eitskin.training.adaptation.recorded_touches import RecordedTouches
    from eitskin.training.method.known_frames import FrameLabel
    from eitskin.training.pipeline.pipeline import Pipeline

FORCE = 8.0  # N, of the presses on a virtual board
REPEAT, SKIP = "r", "s"


def command(
    model: StartModel,
    *,
    out: Annotated[Path, typer.Option(help="File of the sensor's own pipeline, NAME.eitmodel.")],
    board: BoardOption = None,
    sensor: SensorFile = None,
    angles: Angles = "-20,-2.5,15,32.5,50",
    presses: Annotated[int, typer.Option(min=0, help="Number of presses that are asked for.")] = 10,
    frames: Annotated[int, typer.Option(min=1, help="Number of frames in each pose.")] = 8,
    no_prompt: Annotated[
        bool,
        typer.Option("--no-prompt", help="Ask nothing: for a virtual: board, which moves itself."),
    ] = False,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Set up a new sensor: port, check, zero, known angles, presses, and its own pipeline.

    Every step can be repeated or skipped. With `none` in place of a pipeline, and a --sensor, touch
    positions are learned from the presses alone.
    """
    from eitskin.geometry.design.sensor import SensorDesign
    from eitskin.training.pipeline.saved_form import require_writable

    output = Output(as_json, quiet, verbose)
    require_writable(out)
    start = open_start(model, None)
    design = SensorDesign.from_toml(sensor) if sensor else _design(start)
    wanted = angles_of(angles)
    setup = Setup(model, start, design, out, board or "", frames, no_prompt, seed, output)
    try:
        setup.run(wanted, presses)
    except (KeyboardInterrupt, typer.Abort):
        output.note(setup.kept)
        raise KeyboardInterrupt from None


@dataclass
class Setup:
    """State of a set-up: what was chosen, and what is kept so far.

    Attributes:
        model: name of the pipeline to start from, or `none`.
        start: that pipeline; None for none.
        design: of the sensor; None where nothing tells it.
        out: of the sensor's own pipeline.
        board: URI; empty before a port was chosen.
        frames: number in each pose.
        no_prompt: whether nothing is asked.
        seed: of a virtual board.
        output: of the command.
        taken: labelled frames by the step that took them.
        zero: file of the stored reference; None before it was taken.
    """

    model: Path
    start: "Pipeline | RecordedTouches | None"
    design: "SensorDesign | None"
    out: Path
    board: str
    frames: int
    no_prompt: bool
    seed: int
    output: Output
    taken: "dict[str, list[tuple[Frame, FrameLabel]]]" = field(default_factory=dict)
    zero: Path | None = None

    @property
    def recorded(self) -> Path:
        """Folder of the labelled frames."""
        return self.out.with_name(f"{self.out.stem}-frames")

    @property
    def kept(self) -> str:
        """Sentence about what is kept when the set-up ends early."""
        files = [str(self.zero)] if self.zero else []
        files += [str(self.recorded)] if self.taken else []
        if not files:
            return "nothing was kept: no step that writes a file was finished"
        again = f"; go on by: eitskin adapt {self.model} {self.recorded} --out {self.out}"
        return f"kept: {', '.join(files)}{again if self.taken else ''}"

    def run(self, angles: list[float], presses: int) -> None:
        """Go through all steps."""
        if not self.board:
            self._choose_board()
        if self.start is not None:
            self._step("check", "is the sensor on the board healthy?", self._check)
            self._step("zero", "its flat, untouched state is stored", self._tare)
        if self.start is not None and self.start.targets.angle and angles:
            self._step("angles", f"{len(angles)} known bend angles", lambda: self._bend(angles))
        if presses:
            self._step(
                "presses", f"{presses} presses at named places", lambda: self._press(presses)
            )
        self._finish()

    def _step(self, name: str, what: str, run: Callable[[], None]) -> None:
        """Run a step, as often as wanted; its errors are told, and it may be repeated."""
        if self.no_prompt:
            self.output.note(f"{name}: {what}")
            run()
            return
        answer = self._ask(f"{name}: {what}. Enter to begin, {SKIP} to skip")
        while answer != SKIP:
            try:
                run()
                answer = self._ask(f"{name}: done. Enter to go on, {REPEAT} to repeat")
            except EitskinError as error:
                self.output.note(f"{name}: {error}")
                answer = self._ask(f"{name}: Enter to go on without it, {REPEAT} to repeat")
            if answer != REPEAT:
                return

    def _ask(self, text: str) -> str:
        return str(typer.prompt(text, "", show_default=False, err=True)).strip().lower()

    def _choose_board(self) -> None:
        """Choose a port of this machine, or a board by its URI."""
        from eitskin.hardware.boards.port import serial_ports

        if self.no_prompt:
            self.board = "virtual:?speed=max"
            return
        ports = serial_ports()
        for number, port in enumerate(ports, 1):
            self.output.note(f"{number}: {port}")
        known = "a number, " if ports else "no serial port was found here; "
        while not self.board:
            text = self._ask(f"board: {known}or a URI such as virtual: or serial:PORT")
            if text.isdigit() and 1 <= int(text) <= len(ports):
                self.board = ports[int(text) - 1].uri
            elif ":" in text:
                self.board = text

    def _open(self) -> "Board":
        from eitskin.hardware.opening import open_board

        return open_board(self.board, **seeded(self.board, self.seed))

    def _check(self) -> None:
        """The sensor check; findings are told, and the step may be repeated."""
        if self.start is None:
            return
        try:
            check.check_board(
                self.start, self.board, 16, self._quiet, None,
                named=True, calibrate=False, seed=self.seed,
            )  # fmt: skip
        except typer.Exit as found:
            if found.exit_code and self.no_prompt:
                raise

    @property
    def _quiet(self) -> Output:
        """Output of steps, whose results are notes of this command."""
        return Output(False, self.output.quiet, self.output.verbose, self.output.notes)

    def _tare(self) -> None:
        pipeline = self.start
        if pipeline is None:
            return
        from eitskin.training.pipeline.stored_reference import Zero

        path = self.out.with_suffix(".json")
        reference = tare.taken_from_board(
            pipeline, self.board, 32, Zero.FLAT, self.seed, self._quiet
        )
        reference.write(path)
        pipeline.use(None)
        self.zero = path
        self.output.note(f"{path}: the zero of this sensor, for --reference")

    def _bend(self, angles: list[float]) -> None:
        self._take("angles", [bent(0.0), *(bent(angle) for angle in angles)])

    def _press(self, count: int) -> None:
        if self.design is None:
            raise ConfigurationError(
                "expected the sensor's outline, to name places on it, got none; give --sensor"
            )
        places = press_places(self.design, count)
        self.output.note(place_map(self.design, places))
        half = (count + 1) // 2
        named = [pressed(str(number), x, y) for number, (x, y) in enumerate(places, 1)]
        self._take("presses", [bent(0.0), *named[:half], bent(0.0), *named[half:]])

    def _take(self, name: str, poses: "list[Pose]") -> None:
        """Frames in poses, kept in the folder of labelled frames once all are taken."""
        from eitskin.datasets.store.folder import save_dataset
        from eitskin.files import atomic_folder

        hand = staged(FORCE) if self.no_prompt else asked
        with self._open() as board:
            done = frames_in_poses(
                board, poses, self.frames, hand, lambda pose: self.output.detail(pose.words)
            )
            taken = {**self.taken, name: list(done)}
        data = as_dataset([each for step in taken.values() for each in step], self.design)
        with atomic_folder(self.recorded) as made:
            save_dataset(data, made)
        self.taken = taken

    def _finish(self) -> None:
        """Adapt to the labelled frames, save, and say the next command."""
        from eitskin.datasets.store.folder import open_dataset

        if not self.taken:
            raise ConfigurationError(
                "no labelled frames to adapt to, all steps that take them were skipped; "
                f"{self.kept}"
            )
        adapted = adapt(self.start, open_dataset(self.recorded))
        saved = adapted.save(self.out)
        zero = f" --reference {self.zero}" if self.zero else ""
        following = f"eitskin live {saved} --board '{self.board}'{zero} --page"
        result = {
            "out": str(saved),
            "frames": str(self.recorded),
            "reference": str(self.zero or ""),
            "next": following,
            **said(adapted),
        }
        self.output.result(result, f"{saved}: {in_words(adapted)}\nnext: {following}")


def _design(start: "Pipeline | RecordedTouches | None") -> "SensorDesign | None":
    """Design of a pipeline's sensor; None where it has none."""
    from eitskin.training.pipeline.pipeline import Pipeline

    if start is None:
        return None
    return start.layout.design if isinstance(start, Pipeline) else start.design
