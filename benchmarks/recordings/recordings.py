"""Real recordings through the same code as simulated frames.

Run by `python -m eitskin.benchmarks.recordings.recordings FOLDER`.

FOLDER holds `ohmc8.mat`, 500 presses of a robot on a round hydrogel skin of 32 channels, and
`openeit_background_8.txt`, a frame of all 28 pairs of another board. Prints, as
Markdown, how far places learned from the first presses are off on the last, and how large the other
board's values are beside those that the shipped pipeline was trained with.
"""

import argparse
from pathlib import Path

import numpy as np

from eitskin.datasets.recordings.form import RecordingNames
from eitskin.datasets.recordings.recording import read_recording
from eitskin.errors import FrameError
from eitskin.provenance import Provenance
from eitskin.training.evaluation.position_score import PositionScore
from eitskin.training.method.settings import TrainingSettings
from eitskin.training.pipeline.pipeline import Pipeline

PRESSES, BOARD_FRAME = "ohmc8.mat", "openeit_background_8.txt"


def main() -> None:
    """Print both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="where both files are")
    folder = parser.parse_args().folder
    print(f"{Provenance.now(0)}\n")
    names = RecordingNames("responsedowns", "responseups", "positions")
    recording = read_recording(folder / PRESSES, names)
    learned = Pipeline.fit(recording, TrainingSettings("touch position"))
    score = PositionScore.of(learned, recording)
    print(f"- presses, and those that places are tested on: {len(recording)}, {score.frames}")
    print(f"- mean error of a place [mm]: {score.mean_error_mm:.2f}")
    print(f"- the same of always saying the middle [mm]: {score.guess_error_mm:.1f}")
    board_frame(folder / BOARD_FRAME)


def board_frame(path: Path) -> None:
    """Print the size of the values, and whether the shipped pipeline accepts them."""
    pipeline = Pipeline.load("reference.eitmodel")
    recording = read_recording(path, protocol=pipeline.layout.protocol)
    values = np.abs(recording.impedance[0])
    common = np.exp(np.median(np.log(values / pipeline.layout.reference)))
    print(f"- values of another board beside those trained with: {common:.1f}")
    try:
        pipeline.process(recording.frame(0))
    except FrameError as error:
        print(f"\nrefused: {error}")


if __name__ == "__main__":
    main()
