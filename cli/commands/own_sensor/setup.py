"""`eitskin setup`: a new sensor at a board, step by step, to a pipeline of its own."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Annotated

import typer

from eitskin import datasets, geometry, hardware, simulator, training
from eitskin.cli.commands import check, tare
from eitskin.cli.commands.own_sensor import adapt, poses
from eitskin.cli.options import (
    BoardOption,
    Output,
    Replace,
    SensorFile,
    opened_board,
    with_output,
)
from eitskin.errors import ConfigurationError, DataError, DeviceError, PartialError

FORCE = 8.0  # N, of the presses on a virtual board
REPEAT, SKIP = "r", "s"


@dataclass(frozen=True)
class SetupOptions:
    """Number of frames and presses, and angles, that a set-up takes."""

    angles: adapt.Angles = adapt.ANGLES
    presses: Annotated[
        int | None,
        typer.Option(min=0, help="Number of touches to ask for; 10, or 50 without a pipeline."),
    ] = None
    frames: Annotated[int, typer.Option(min=1, help="Number of frames in each pose.")] = 8

    def __post_init__(self) -> None:
        """Check the numbers."""
        if (self.presses or 0) < 0 or self.frames < 1:
            raise ConfigurationError(
                "expected no negative number of presses, and a frame or more in each pose, got "
                f"{self.presses} and {self.frames}"
            )
        adapt.parse_angles(self.angles)


@with_output
def command(
    model: adapt.StartModel,
    *,
    out: Annotated[Path, typer.Option(help="File of the sensor's own pipeline, NAME.eitmodel.")],
    board: BoardOption = None,
    sensor: SensorFile = None,
    options: SetupOptions,
    no_prompt: Annotated[
        bool,
        typer.Option("--no-prompt", help="Ask nothing; only with a virtual: board."),
    ] = False,
    replace: Replace = False,
    seed: int = 0,
    output: Output,
) -> None:
    """Set up a new sensor, step by step: check, reference, known angles, touches, its pipeline.

    Every step can be repeated or skipped. With `none` in place of a pipeline, and a --sensor, touch
    positions are learned from the touches alone.
    """
    from eitskin.training.pipeline.saved_form import require_writable

    require_writable(out, replace)
    dialogue, start = poses.TerminalDialogue(output), adapt.open_start(model, None)
    hand = poses.stage_poses(FORCE) if no_prompt else poses.ask_for_poses(dialogue)
    design = geometry.SensorDesign.from_toml(sensor) if sensor else None
    setup = Setup(model, start, out, options, dialogue, hand, design, asks=not no_prompt)
    if setup.frames_folder.exists() and not replace:
        raise ConfigurationError(
            f"{setup.frames_folder} exists and is not replaced; {setup.next_command}, choose "
            "another --out, or give --replace"
        )
    try:
        uri = board or ("virtual:?speed=max" if no_prompt else _chosen_board(dialogue))
        adapted = setup.run(partial(opened_board, uri, seed, start.layout if start else None))
    except (KeyboardInterrupt, typer.Abort):
        output.note(setup.kept_files_note, whole=True)
        raise KeyboardInterrupt from None
    following = setup.live_command(uri)
    result = {
        "out": str(setup.out),
        "frames": str(setup.frames_folder),
        "reference": str(setup.zero or ""),
        **adapt.adaptation_facts(adapted),
        "next": following,
    }
    output.result(result, f"{setup.out}: {adapt.in_words(adapted)}\nnext: {following}")


def _chosen_board(dialogue: poses.Dialogue) -> str:
    """Port of this machine that a person chooses, or a board by its URI."""
    from eitskin.hardware.boards.port import serial_ports

    ports = serial_ports()
    for number, port in enumerate(ports, 1):
        dialogue.note(f"{number}: {port}")
    if not ports:
        dialogue.note("no serial port was found here")
    numbers = {0: "", 1: "1, or "}.get(len(ports), f"a number from 1 to {len(ports)}, or ")
    expected = f"{numbers}a URI such as virtual: or serial:PORT"
    while True:
        text = dialogue.ask(f"board: {expected}", {})
        if text.isdigit() and 1 <= int(text) <= len(ports):
            return ports[int(text) - 1].uri
        if ":" in text:
            return text
        dialogue.note(f"expected {expected}, got {text!r}")


@dataclass
class Setup:
    """State of a set-up: what was chosen, and what is kept so far.

    Attributes:
        model: name of the pipeline to start from, or `none`.
        start: start that pipeline; None for none.
        out: out of the sensor's own pipeline.
        options: number of frames, presses and angles.
        dialogue: dialogue with the person at the sensor.
        hand: way of bringing it into a pose.
        design: design of the sensor; that of the pipeline when omitted, None where nothing shows
            it.
        asks: whether steps can be repeated and skipped.
        taken: labelled frames by the step that took them.
        zero: file of the stored reference; None before it was taken.
        adapted: the sensor's own pipeline, in the end.
    """

    model: Path
    start: "training.Pipeline | None"
    out: Path
    options: SetupOptions
    dialogue: poses.Dialogue
    hand: poses.Hand
    design: "geometry.SensorDesign | None" = None
    asks: bool = True
    taken: "dict[str, list[tuple[simulator.Frame, training.FrameLabel]]]" = field(
        default_factory=dict
    )
    zero: Path | None = None
    adapted: "training.Pipeline" = field(init=False)

    def __post_init__(self) -> None:
        """Take the pipeline's design, where no other is given."""
        if self.design is None and self.start is not None:
            self.design = self.start.layout.known_design

    @property
    def presses(self) -> int:
        """Number of touches to ask for: more where they alone must cover the sheet."""
        usual = 50 if self.start is None else 10
        return usual if self.options.presses is None else self.options.presses

    @property
    def frames_folder(self) -> Path:
        """Folder of the labelled frames."""
        return self.out.with_name(f"{self.out.stem}-frames")

    @property
    def kept_files_note(self) -> str:
        """Sentence about what is kept when the set-up ends early."""
        files = [str(self.zero)] if self.zero else []
        files += [str(self.frames_folder)] if self.taken else []
        if not files:
            return "nothing was kept: no step that writes a file was finished"
        return f"kept: {', '.join(files)}{f'; {self.next_command}' if self.taken else ''}"

    @property
    def next_command(self) -> str:
        """Words that say how to learn from the labelled frames that are kept."""
        return f"go on by: eitskin adapt {self.model} {self.frames_folder} --out {self.out}"

    def live_command(self, uri: str) -> str:
        """Command that goes on with the sensor's own pipeline."""
        reference = f" --reference {self.zero}" if self.zero else ""
        return f"eitskin live {self.out} --board '{uri}'{reference} --page"

    def run(self, open_board: "Callable[[], hardware.Board]") -> "training.Pipeline":
        """Go through all steps with a board, which each opens and closes.

        Raises ConfigurationError where no step took frames to learn from.
        """
        start, presses = self.start, self.presses
        angles = adapt.parse_angles(self.options.angles)
        steps: list[tuple[str, str, Callable[[hardware.Board], str]]] = []
        if start is not None:
            check_sensor, store_zero = partial(self._check, start), partial(self._tare, start)
            steps.append(("check", "is the sensor on the board healthy?", check_sensor))
            steps.append(("zero", "its flat, untouched state is stored", store_zero))
            if start.targets.angle and angles:
                steps.append(("angles", f"{len(angles)} known bend angles", self._bend))
        if presses:
            steps.append(("presses", f"{presses} touches at named positions", self._press))
        for name, what, work in steps:
            self._step(name, what, open_board, work)
        return self._finish()

    def _step(
        self,
        name: str,
        what: str,
        open_board: "Callable[[], hardware.Board]",
        work: "Callable[[hardware.Board], str]",
    ) -> None:
        """Run a step, as often as wanted; its errors are reported, and it may be repeated."""

        def run() -> str:
            with open_board() as board:
                return work(board)

        if not self.asks:
            self.dialogue.note(f"{name}: {what}")
            self.dialogue.note(f"{name}: {run()}")
            return
        answer = self.dialogue.ask(f"{name}: {what}", {"": "Start", SKIP: "Skip"})
        while answer != SKIP:
            try:
                answer = self.dialogue.ask(f"{name}: {run()}", {"": "Continue", REPEAT: "Repeat"})
            except (ConfigurationError, DataError, DeviceError, PartialError) as error:
                choices = {"": "Continue without it", REPEAT: "Repeat"}
                answer = self.dialogue.ask(f"{name}: {error}", choices)
            if answer != REPEAT:
                return

    def _check(self, start: "training.Pipeline", board: "hardware.Board") -> str:
        """The sensor check; findings are reported, and the step may be repeated."""
        start.layout.require_same_measurements(board.protocol, board.info.frequency)
        check_frames = list(islice(board.frames(), check.FRAMES))
        findings = check.sensor_findings(start, check_frames)
        text = findings.describe(len(check_frames))
        if findings.findings and not self.asks:
            self.dialogue.note(text)
            raise typer.Exit(check.EXIT_UNHEALTHY)
        return text

    def _tare(self, start: "training.Pipeline", board: "hardware.Board") -> str:

        reference = tare.measure_reference(start, board, tare.FRAMES, training.Zero.FLAT)
        start.use(None)
        self.zero = reference.write(self.out.with_suffix(".json"))
        return f"{self.zero} is the zero of this sensor, for --reference"

    def _bend(self, board: "hardware.Board") -> str:
        angles = 0.0, *adapt.parse_angles(self.options.angles)
        return self._take(board, "angles", [poses.bent_pose(angle) for angle in angles])

    def _press(self, board: "hardware.Board") -> str:
        count = self.presses
        if self.design is None:
            raise ConfigurationError(
                "expected the sensor's outline, to name places on it, got none; give --sensor"
            )
        places = poses.press_places(self.design, count)
        self.dialogue.sketch(poses.place_map(self.design, places))
        half = (count + 1) // 2
        named = [poses.pressed_pose(str(number), x, y) for number, (x, y) in enumerate(places, 1)]
        flat = poses.bent_pose(0.0)
        return self._take(board, "presses", [flat, *named[:half], flat, *named[half:]])

    def _take(self, board: "hardware.Board", name: str, pose_list: list[poses.Pose]) -> str:
        """Frames in poses, kept in the folder of labelled frames once all are taken."""
        from eitskin.files import atomic_folder

        done = poses.frames_in_poses(
            board,
            pose_list,
            self.options.frames,
            self.hand,
            lambda pose: self.dialogue.note(f"taken: {pose.words}"),
            newest=self.asks,
        )
        frames = {**self.taken, name: list(done)}
        data = poses.as_dataset([each for step in frames.values() for each in step], self.design)
        with atomic_folder(self.frames_folder) as new_folder:
            datasets.save_dataset(data, new_folder)
        self.taken = frames
        return f"{len(frames[name])} frames in {len(pose_list)} poses"

    def _finish(self) -> "training.Pipeline":
        """Adapt to the labelled frames, and save."""
        if not self.taken:
            raise ConfigurationError(
                "no labelled frames to adapt to, all steps that take them were skipped; "
                f"{self.kept_files_note}"
            )
        self.dialogue.note("learning from the labelled frames")
        self.adapted = adapt.adapt(self.start, datasets.open_dataset(self.frames_folder))
        self.out = self.adapted.save(self.out)
        return self.adapted
