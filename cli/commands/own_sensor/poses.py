"""Poses of a sensor, the person who brings it into them, and its frames there."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import typer

from eitskin import datasets, geometry, hardware, simulator, training
from eitskin.cli.options import Output
from eitskin.errors import ConfigurationError, DataError


class Dialogue(Protocol):
    """Way to the person at a sensor: a terminal, or a page."""

    def ask(
        self, text: str, choices: Mapping[str, str], place: tuple[float, float] | None = None
    ) -> str:
        """Wait for the answer to a question.

        Args:
            text: the question.
            choices: words of the possible answers, by answer; an empty answer comes first. Empty
                where the answer may be anything.
            place: position on the sensor that the question is about [m].
        """

    def note(self, text: str) -> None:
        """Report what is done, or what came of it."""

    def sketch(self, text: str) -> None:
        """Show a map in letters, where places are not shown otherwise."""


@dataclass(frozen=True, slots=True)
class TerminalDialogue(Dialogue):
    """Dialogue in the terminal: Enter, or a letter and Enter."""

    output: Output

    def ask(
        self,
        text: str,
        choices: Mapping[str, str],
        place: tuple[float, float] | None = None,  # noqa: ARG002
    ) -> str:
        keys = ", ".join(f"{key or 'Enter'}: {words}" for key, words in choices.items())
        shown = f"{text} ({keys})" if keys else text
        typed = str(typer.prompt(shown, "", show_default=False, err=True)).strip()
        return typed.lower() if choices else typed  # a port's name may have capitals

    def note(self, text: str) -> None:
        self.output.note(text)

    sketch = note


MAP_COLUMNS = 48
STALE = 2  # frames after a prompt that may have begun before it was answered

Hand = Callable[["hardware.Board", "Pose", "Iterator[simulator.Frame]"], None]
"""Way of bringing a sensor into a pose; frames that began before are taken from the iterator."""


@dataclass(frozen=True, slots=True)
class Pose:
    """State that a sensor is brought into.

    Attributes:
        words: instruction for a person.
        label: labels of its frames.
    """

    words: str
    label: "training.FrameLabel"


def bent_pose(angle_deg: float) -> Pose:
    """Pose of the untouched sensor at an angle."""
    words = "lay it flat" if angle_deg == 0 else f"bend it by {angle_deg:g} deg"
    return Pose(f"{words}, untouched", training.FrameLabel(angle_deg))


def pressed_pose(name: str, x: float, y: float) -> Pose:
    """Pose of the flat sensor with a press at a place [m]."""
    words = f"press at {name}: x {1e3 * x:.0f} mm, y {1e3 * y:.0f} mm, and hold"
    return Pose(words, training.FrameLabel(touches=(training.TouchLabel(x, y),)))


def ask_for_poses(dialogue: "Dialogue") -> Hand:
    """Ask a person for each pose, and wait until it is held."""

    def wait(_board: "hardware.Board", pose: Pose, stream: "Iterator[simulator.Frame]") -> None:
        touches = pose.label.touches or ()
        place = next(((touch.x, touch.y) for touch in touches), None)
        dialogue.ask(pose.words, {"": "it is so"}, place)
        for _ in range(STALE):
            next(stream)

    return wait


def left_alone(_board: "hardware.Board", _pose: Pose, _stream: "Iterator[simulator.Frame]") -> None:
    """Do nothing: the board goes through the poses on its own."""


def stage_poses(force: float) -> Hand:
    """Bring the simulated sensor of a virtual board into its poses, pressed by a force [N]."""

    def move_stage(
        board: "hardware.Board", pose: Pose, stream: "Iterator[simulator.Frame]"
    ) -> None:

        if board.stage is None:
            raise ConfigurationError(
                "--no-prompt is for a virtual: board, whose sensor moves on its own, got another "
                "board; leave it out"
            )
        touches = tuple(simulator.Touch(each.x, each.y, force) for each in pose.label.touches or ())
        scene = simulator.Scene(geometry.Bend(pose.label.angle_deg or 0.0), touches)
        board.stage.set(scene)
        while board.stage.truth(next(stream).number) != scene:
            pass

    return move_stage


def frames_in_poses(
    board: "hardware.Board",
    poses: Sequence[Pose],
    count: int,
    hand: Hand,
    on_done: Callable[[Pose], None] = lambda _: None,
    *,
    newest: bool = False,
) -> "Iterator[tuple[simulator.Frame, training.FrameLabel]]":
    """So many frames in each pose, with what is known of them.

    Args:
        board: open.
        poses: poses in their order.
        count: number of frames in each.
        hand: way of bringing the sensor into a pose.
        on_done: called after the frames of a pose.
        newest: skip frames that came while the hand was at it.
    """
    stream = board.frames(newest=newest)
    for pose in poses:
        hand(board, pose, stream)
        for _ in range(count):
            yield next(stream), pose.label
        on_done(pose)


def as_dataset(
    labelled_frames: "Sequence[tuple[simulator.Frame, training.FrameLabel]]",
    design: "geometry.SensorDesign | None",
) -> "datasets.Dataset":
    """Labelled frames of one sensor as a dataset.

    A touched frame is compared with the mean of the latest untouched frames, in succession and of
    its angle, before it. The flat reference is the mean of all flat frames.

    Raises DataError where no frame is flat and untouched.
    """
    import numpy as np

    from eitskin.datasets.store.schema import MAX_TOUCHES

    values = np.array([frame.impedance for frame, _ in labelled_frames])
    labels = [label for _, label in labelled_frames]
    flat = [row for row, label in enumerate(labels) if label.flat]
    if not flat:
        raise DataError(
            "expected frames of the flat, untouched sensor among the labelled ones, got none; "
            "repeat the step that lays it flat"
        )
    before = np.full(values.shape, np.nan, complex)
    x, y = np.full((2, len(labelled_frames), MAX_TOUCHES), np.nan)
    latest: list[int] = []
    for row, label in enumerate(labels):
        if not label.touches:
            same = latest and labels[latest[-1]] == label and latest[-1] == row - 1
            latest = [*latest, row] if same else [row]
            continue
        for k, touch in enumerate(label.touches):
            x[row, k], y[row, k] = touch.x, touch.y
        if latest and labels[latest[-1]].angle_deg == label.angle_deg:
            before[row] = values[latest].mean(axis=0)
    states = [
        datasets.State.TOUCH
        if label.touches
        else datasets.State.IDLE
        if label.flat
        else datasets.State.BEND
        for label in labels
    ]
    first = labelled_frames[0][0]
    return datasets.Dataset.from_arrays(
        values,
        values[flat].mean(axis=0),
        touch_reference=before,
        specimen=np.zeros(len(labelled_frames)),
        state=states,
        bend_angle_deg=[label.angle_deg for label in labels],
        touch_x=x,
        touch_y=y,
        time=np.arange(len(labelled_frames)) * _period(labelled_frames),
        status=np.array([frame.status for frame, _ in labelled_frames]),
        protocol=first.protocol,
        frequency=first.frequency,
        design=design,
    )


def _period(labelled_frames: "Sequence[tuple[simulator.Frame, training.FrameLabel]]") -> float:
    """Mean time from frame to frame [s]; the clock of a board may begin again at each step."""
    steps = [b.time - a.time for (a, _), (b, _) in pairwise(labelled_frames)]
    forward = [step for step in steps if step > 0.0]
    return sum(forward) / len(forward) if forward else 1.0


def press_places(design: "geometry.SensorDesign", count: int) -> list[tuple[float, float]]:
    """Places (x, y) [m] spread over a plane sensor, each as far from all others as can be.

    Raises ConfigurationError for an outline that is no plane one.
    """
    import numpy as np

    outline = _plane(design)
    inset = 0.12 * min(outline.length, outline.width)
    x, y = np.meshgrid(*(np.linspace(0.0, size, 61) for size in (outline.length, outline.width)))
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    around = inset * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    inner = np.all([outline.contains(points + step) for step in around], axis=0)
    points = points[inner & np.asarray(outline.contains(points))]
    middle = points.mean(axis=0)
    chosen = [int(np.argmax(np.linalg.norm(points - middle, axis=1)))]
    away = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(away)))
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return [(float(a), float(b)) for a, b in points[chosen]]


def place_map(design: "geometry.SensorDesign", places: Sequence[tuple[float, float]]) -> str:
    """Small map of a plane sensor, y upwards, with the numbers of places from 1."""
    import numpy as np

    outline, width = _plane(design), MAP_COLUMNS
    rows = max(5, round(0.5 * width * outline.width / outline.length))
    x = (np.arange(width) + 0.5) / width * outline.length
    y = (np.arange(rows) + 0.5) / rows * outline.width
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    inside = np.asarray(outline.contains(grid)).reshape(rows, width)
    drawn = np.where(inside, ".", " ").astype(object)
    for number, (a, b) in enumerate(places, 1):
        row = min(int(b / outline.width * rows), rows - 1)
        column = min(int(a / outline.length * width), width - 1)
        for k, digit in enumerate(str(number)):
            drawn[row, min(column + k, width - 1)] = digit
    return "\n".join("".join(line) for line in drawn[::-1])


def _plane(design: "geometry.SensorDesign") -> "geometry.PlaneOutline":
    """Outline of a plane sensor; raises ConfigurationError for any other."""
    if not isinstance(design.outline, geometry.PlaneOutline):
        raise ConfigurationError(
            "places are named on plane sensors, got a surface; label own presses with eitskin "
            "import, and use eitskin adapt"
        )
    return design.outline
