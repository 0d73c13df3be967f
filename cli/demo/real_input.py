"""Real recordings through the same code as simulated frames."""

import dataclasses
import hashlib
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from eitskin.cli.demo.parts import REMEDY, Part, drawn_picture
from eitskin.cli.demo.pictures import found_presses, two_sensors
from eitskin.datasets.recordings import RecordingNames, read_recording
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.folder import save_dataset
from eitskin.errors import DataError, FrameError, PartialError
from eitskin.protocol import Protocol
from eitskin.training.evaluation.report.drawing import style

if TYPE_CHECKING:
    from eitskin.training.pipeline.pipeline import Pipeline

PUBLISHED_MM = 4.5  # mean error that is published beside the presses


def sums(data: Path | None) -> dict[str, str]:
    """SHA-256 of the recordings in `data`, or where one is missed, by their names.

    Raises DataError where one may not be read.
    """
    return {file: _sum(data, file) for file, _ in RECORDINGS.values()}


def _sum(data: Path | None, file: str) -> str:
    if data is None or not (data / file).is_file():
        return f"not in {data}"
    try:
        return hashlib.sha256((data / file).read_bytes()).hexdigest()
    except OSError as error:
        reason = f"cannot read {data / file}: {error.strerror}"
        raise DataError(f"{reason}; make it readable, or leave out --data") from error


def real(data: Path | None, out: Path, pipeline: "Pipeline") -> Part:
    """Learn touch positions from real presses; put a real board's frame through the checks.

    Says how to give them where `data` or a file in it is absent.
    """
    parts: dict[str, Part] = {}
    for name, (file, measure) in RECORDINGS.items():
        if data is not None and (data / file).is_file():
            parts[name] = measure(data / file, out, pipeline)
        else:
            place = data if data is not None else "the folder that --data names"
            told = f"{file}: not found in {place}; give the folder that holds it as --data"
            parts[name] = Part({}, told=(told,))
    return _joined(parts)


def _joined(parts: Mapping[str, Part]) -> Part:
    """One part of all recordings."""
    return Part(
        {name: part.numbers for name, part in parts.items() if part.numbers},
        {name: picture for part in parts.values() for name, picture in part.pictures.items()},
        tuple(sentence for part in parts.values() for sentence in part.told),
    )


def _presses(path: Path, out: Path, pipeline: "Pipeline") -> Part:  # noqa: ARG001
    """500 robot presses on a round hydrogel skin with 32 channels of unknown order."""
    from eitskin.training.positions.recorded_touches import RecordedTouches

    names = RecordingNames("responsedowns", "responseups", "positions")
    recording = read_recording(path, names)
    learned = RecordedTouches.fit(recording)
    score = learned.evaluate(recording)
    learned.save(out / "presses.eitmodel")
    told = (
        f"{path.name}: {len(recording)} presses, learned from the first 80 % in time: mean error "
        f"{score.mean_error_mm:.1f} mm on the last {score.frames} (published beside the data: "
        f"{PUBLISHED_MM} mm; always saying the middle: {score.guess_error_mm:.0f} mm)"
    )
    with style():
        drawn = found_presses(*learned.found(recording), path.name)
        picture = drawn_picture(drawn, "Lines from true places of real presses to those found")
    numbers = {"presses": len(recording), "published_mm": PUBLISHED_MM, **score.as_dict()}
    return Part(numbers, {"presses": picture}, (told,))


def _board_frame(path: Path, out: Path, pipeline: "Pipeline") -> Part:
    """One frame of all 28 pairs of a real board, replayed as if live."""
    recording = read_recording(path, protocol=Protocol.pairwise(8))
    own, measured = pipeline.layout.reference, np.abs(recording.impedance[0]).astype(float)
    numbers: dict[str, Any] = {
        "median_ratio": float(np.median(measured / own)),
        **_replayed(recording, out, pipeline),
    }
    if numbers["refused"]:
        told = f"{path.name}: replayed; the pipeline refuses it: {numbers['refused']}"
    else:
        told = f"{path.name}: replayed; {numbers['state']}, {'; '.join(numbers['problems'])}"
    with style():
        drawn = two_sensors(own, measured, pipeline.layout.protocol.labels, path.name)
        picture = drawn_picture(drawn, "Values of a real board's frame beside those trained with")
    return Part(numbers, {"board_frame": picture}, (told,))


def _replayed(recording: Dataset, out: Path, pipeline: "Pipeline") -> dict[str, object]:
    """What the pipeline says of the recording's first frame when a board replays it."""
    from eitskin.hardware.opening import open_board

    try:
        with tempfile.TemporaryDirectory(prefix=".replay-", dir=out) as parent:
            folder = Path(parent) / "frame"
            save_dataset(recording, folder)
            with open_board(f"replay:{folder}") as board:
                frame = next(iter(board.frames()))
    except PartialError:
        raise
    except OSError as error:
        raise PartialError(f"cannot write in {out}: {error.strerror}; {REMEDY}") from error
    try:
        estimate = dataclasses.replace(pipeline).process(frame)
    except FrameError as error:
        return {"refused": str(error), "state": None, "problems": []}
    state, problems = estimate.state.name.lower(), list(estimate.problems)
    return {"refused": None, "state": state, "problems": problems}


RECORDINGS = {
    "presses": ("ohmc8.mat", _presses),
    "board_frame": ("openeit_background_8.txt", _board_frame),
}
"""By the name that their numbers have: the file, and what is done with it."""
