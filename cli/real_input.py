"""Real recordings through the same code as simulated frames."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from eitskin.cli.options import Output
from eitskin.datasets import RecordingNames, read_recording, save_dataset
from eitskin.geometry import FrameError
from eitskin.simulator import Protocol

if TYPE_CHECKING:
    from eitskin.training import Pipeline

PRESSES = "ohmc8.mat"
BOARD_FRAME = "openeit_background_8.txt"


def run_real_input(
    data: Path | None, out: Path, pipeline: "Pipeline", output: Output
) -> dict[str, Any]:
    """Learn touch positions from real presses; put a real board's frame through the checks.

    Says clearly, and does nothing, where `data` or a file in it is absent.
    """
    found: dict[str, Any] = {}
    for name, what in ((PRESSES, _presses), (BOARD_FRAME, _board_frame)):
        if data is None or not (data / name).is_file():
            place = data if data is not None else "the folder that --data names"
            output.show(f"{name}: not found in {place}; give the folder that holds it as --data")
            continue
        found[name] = what(data / name, out, pipeline, output)
    return found


def _presses(path: Path, out: Path, pipeline: "Pipeline", output: Output) -> dict[str, Any]:  # noqa: ARG001
    """500 robot presses on a round hydrogel skin with 32 channels of unknown order."""
    from eitskin.training import RecordedTouches

    names = RecordingNames("responsedowns", "responseups", "positions")
    recording = read_recording(path, names)
    learned = RecordedTouches.fit(recording)
    score = learned.evaluate(recording)
    learned.save(out / "presses.eitmodel")
    output.show(
        f"{path.name}: {len(recording)} presses, learned from the first 80 % in time: mean error "
        f"{score.mean_error_mm:.1f} mm on the last {score.frames} (published beside the data: "
        f"4.5 mm; always saying the middle: {score.guess_error_mm:.0f} mm)"
    )
    return score.as_dict()


def _board_frame(path: Path, out: Path, pipeline: "Pipeline", output: Output) -> dict[str, Any]:
    """One frame of all 28 pairs of a real board, replayed as if live."""
    from eitskin.hardware import open_board

    folder = out / "board_frame"
    if not folder.exists():
        save_dataset(read_recording(path, protocol=Protocol.pairwise(8)), folder)
    with open_board(f"replay:{folder}") as board:
        frame = next(iter(board.frames()))
        try:
            estimate = pipeline.process(frame)
        except FrameError as error:
            output.show(f"{path.name}: replayed; the pipeline refuses it: {error}")
            return {"refused": str(error)}
    output.show(f"{path.name}: replayed; {estimate.state.name.lower()}, {estimate.problems}")
    return {"state": estimate.state.name.lower(), "problems": list(estimate.problems)}
