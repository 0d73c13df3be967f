"""The stage about real recordings, which pass through the same code as simulated frames."""

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from eitskin.cli.commands.train import train_positions
from eitskin.cli.demo.pictures import found_presses, two_sensors
from eitskin.cli.demo.results import StageResult, as_pictures
from eitskin.datasets.recordings.form import RecordingNames
from eitskin.datasets.recordings.recording import read_recording
from eitskin.errors import DataError, FrameError
from eitskin.hardware.streams.reading_record import state_name
from eitskin.protocol import Protocol

if TYPE_CHECKING:
    from eitskin.training.pipeline.pipeline import Pipeline

PUBLISHED_MM = 4.5  # mean error that is published beside the presses


def checksums(data: Path | None) -> dict[str, str]:
    """SHA-256 of each recording in `data`, or the folder in which the file is missing.

    Raises DataError where a file may not be read.
    """
    return {file: _checksum(data, file) for file, _ in RECORDINGS.values()}


def _checksum(data: Path | None, file: str) -> str:
    if data is None or not (data / file).is_file():
        return f"not in {data}"
    try:
        return hashlib.sha256((data / file).read_bytes()).hexdigest()
    except OSError as error:
        reason = f"cannot read {data / file}: {error.strerror}"
        raise DataError(f"{reason}; make it readable, or leave out --data") from error


def real_recordings(data: Path | None, out: Path, pipeline: "Pipeline") -> StageResult:
    """Touch positions learned from real presses, and checks of a frame of a real board.

    A missing file is left out, with a remark on where it belongs.
    """
    joined = StageResult({})
    for name, (file, measure) in RECORDINGS.items():
        if data is not None and (data / file).is_file():
            found = measure(data / file, out, pipeline)
            joined.numbers[name] = found.numbers
            joined.pictures.update(found.pictures)
            remarks = found.remarks
        else:
            folder = data if data is not None else "the folder that --data names"
            remarks = (f"{file}: not found in {folder}; give the folder that holds it as --data",)
        joined = StageResult(joined.numbers, joined.pictures, joined.remarks + remarks)
    return joined


def _presses(path: Path, out: Path, pipeline: "Pipeline") -> StageResult:  # noqa: ARG001
    """500 robot presses on a round hydrogel skin of 32 channels."""
    recording = read_recording(path, RecordingNames("responsedowns", "responseups", "positions"))
    learned = train_positions(recording)
    learned.save(out / "presses.eitmodel")
    score = learned.metrics
    remark = (
        f"{path.name}: {len(recording)} presses, learned from the first 80 % in time: mean error "
        f"{score['mean_error_mm']:.1f} mm on the last {score['frames']} (published beside the "
        f"data: {PUBLISHED_MM} mm; always the middle: {score['guess_error_mm']:.0f} mm)"
    )
    drawn = found_presses(*learned.found(recording), path.name)
    pictures = as_pictures({"presses": (drawn, "True and estimated positions of real presses")})
    numbers = {"presses": len(recording), "published_mm": PUBLISHED_MM, **score}
    return StageResult(numbers, pictures, (remark,))


def _board_frame(path: Path, out: Path, pipeline: "Pipeline") -> StageResult:  # noqa: ARG001
    """One frame of all 28 pairs of a real board, given to the pipeline."""
    recording = read_recording(path, protocol=Protocol.pairwise(8))
    own, measured = pipeline.layout.reference, np.abs(recording.impedance[0]).astype(float)
    answer: dict[str, Any] = {"refused": None, "state": None, "problems": []}
    try:
        estimate = pipeline.process(recording.frame(0))
    except FrameError as error:
        answer["refused"] = str(error)
        remark = f"{path.name}: the pipeline refuses it: {error}"
    else:
        answer |= {"state": state_name(estimate), "problems": list(estimate.problems)}
        remark = f"{path.name}: {answer['state']}, {'; '.join(estimate.problems)}"
    drawn = two_sensors(own, measured, pipeline.layout.protocol.labels, path.name)
    pictures = as_pictures({"board_frame": (drawn, "A real board's frame beside the trained one")})
    numbers = {"median_ratio": float(np.median(measured / own)), **answer}
    return StageResult(numbers, pictures, (remark,))


RECORDINGS = {
    "presses": ("ohmc8.mat", _presses),
    "board_frame": ("openeit_background_8.txt", _board_frame),
}
"""File and measurement of each recording, by the name that its numbers have."""
