"""Makes the files of this folder. It ran on eitskin 0.1.0 and is kept to say what they are.

    python create.py FOLDER

A dataset in two shards, a recording of a live session, a pipeline of the paper's method and one
of touch positions, small enough for a repository, and in `expected.json` what version 0.1 read
from them and estimated with them; `names.txt` has its public names.
`tests/shared/test_version_01.py` holds that they still open and give the same.
"""

import csv
import hashlib
import json
import subprocess
import sys
import zipfile
from dataclasses import fields
from importlib import import_module
from pathlib import Path

import numpy as np
import torch

from eitskin.datasets import Dataset, open_dataset
from eitskin.hardware import open_board
from eitskin.training import NetworkSettings, Pipeline, RecordedTouches, TrainingSettings
from eitskin.training.observed import Observed

SENSOR = """\
thickness = 0.005
outline = { length = 0.15, width = 0.06 }
electrodes = { count = 4, start = 0.0225 }
"""
RECIPE = f"""\
name = "version_01"
description = "Four electrodes, two specimens; idle, bent, and touched flat and bent."
seed = 11
resolution = "fast"
frames_per_shard = 30

[sensor]
{SENSOR}
[instrument]
snr_db = 90.0

[specimens]
count = 2
conductivity = 0.1
contact_impedance = 0.1

[[scenes]]
state = "idle"
count = 12

[[scenes]]
state = "bend"
count = 18
angle_deg = [-20, 50]

[[scenes]]
state = "touch"
count = 30
angle_deg = [-10, 40]
touches = [1, 2]
force = [10, 12]
"""
SCRIPT = """\
[[steps]]
frames = 4
scene = {}

[[steps]]
frames = 4
scene = { bend = { angle_deg = 20 } }

[[steps]]
frames = 4
scene = { bend = { angle_deg = 20 }, touches = [{ x = 0.05, y = 0.03, force = 10 }] }
"""
LEVELS = 32  # to which trained weights are rounded; so few compress well


def eitskin(*words: object) -> str:
    """Run a command; gives its standard output."""
    command = ["eitskin", *map(str, words)]
    return subprocess.run(command, check=True, text=True, stdout=subprocess.PIPE).stdout


def main(folder: Path) -> None:
    """Make everything anew."""
    (folder / "sensor.toml").write_text(SENSOR)
    (folder / "recipe.toml").write_text(RECIPE)
    (folder / "script.toml").write_text(SCRIPT)
    eitskin("generate", folder / "recipe.toml", "--out", folder / "dataset", "--workers", 1)
    dataset = open_dataset(folder / "dataset")
    pipeline = paper_pipeline(dataset)
    pipeline.save(folder / "paper.eitmodel")
    board = f"virtual:?sensor={folder}/sensor.toml&scene={folder}/script.toml&speed=max&seed=3"
    live = ["live", folder / "paper.eitmodel", "--board", board, "--frames", 12, "--every-frame"]
    eitskin(*live, "--record", folder / "recording", "--json")
    position_recording(folder / "presses.csv")
    eitskin("import", folder / "presses.csv", "--out", folder / "presses")
    eitskin("train", folder / "presses", "--out", folder / "positions.eitmodel")
    expected = {
        "dataset": described(dataset),
        "recording": described(open_dataset(folder / "recording")),
        "presses": described(open_dataset(folder / "presses")),
        "paper": perceived(Pipeline.load(folder / "paper.eitmodel"), dataset),
        "paper, recording": session(Pipeline.load(folder / "paper.eitmodel"), folder),
        "positions": positions(folder),
        "reference": reference(),
    }
    (folder / "expected.json").write_text(json.dumps(expected, indent=1) + "\n")
    rooms = ("geometry", "simulator", "datasets", "training", "hardware")
    names = [(room, name) for room in rooms for name in import_module(f"eitskin.{room}").__all__]
    (folder / "names.txt").write_text("".join(f"{room} {name}\n" for room, name in names))
    saved = ("dataset", "recording", "presses", "paper.eitmodel", "positions.eitmodel")
    with zipfile.ZipFile(folder / "saved.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(path for name in saved for path in (folder / name).iterdir()):
            archive.write(path, path.relative_to(folder))


def paper_pipeline(dataset: Dataset) -> Pipeline:
    """A pipeline of the paper's method, briefly trained, with rounded weights.

    The last biases are shifted so that its frames have all states, and touches: the pipeline
    shows what is saved and computed, not how good the method is.
    """
    brief = NetworkSettings(3e-3, epochs=6, batch=8)
    settings = TrainingSettings(classifier=brief, postprocessor=brief)
    pipeline = Pipeline.fit(dataset, settings)
    method = pipeline.method
    for network in (method.classifier.network, method.postprocessor.network):
        for tensor in network.parameters():
            tensor.data = torch.as_tensor(rounded(tensor.detach().numpy()))
    hidden = method.classifier.network.layers[7]
    hidden.weight.data[8:] = 0.0
    for array in (method.reconstruction.matrix, method.classifier.embedding):
        array[...] = rounded(array)
    shown = method.outputs(Observed.of(dataset))
    logits = torch.as_tensor(np.log(shown["probabilities"]), dtype=torch.float32)
    spread = logits.std(dim=0).mean()
    last = method.classifier.network.layers[-1]
    last.bias.data = (last.bias.data - logits.mean(dim=0)) / spread
    last.weight.data /= spread
    brightest = np.quantile(shown["touch_map"].max(axis=(1, 2)), 0.5)
    method.postprocessor.network.layers[-1].bias.data += float(np.log((1 - brightest) / brightest))
    pipeline.examples = pipeline.examples[np.array([0, 2, 4])]  # one of each state
    return pipeline


def rounded(array: np.ndarray) -> np.ndarray:
    """Values to one of so many levels."""
    step = max(float(np.abs(array).max()), 1e-12) / LEVELS
    return (np.round(array / step) * step).astype(array.dtype)


def position_recording(path: Path) -> None:
    """60 presses on a skin of six channels, each a smooth function of the position."""
    rng = np.random.default_rng(5)
    centres = np.array(
        [[0.02, 0.01], [0.06, 0.01], [0.1, 0.02], [0.1, 0.05], [0.06, 0.05], [0.02, 0.05]]
    )
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["t", "state", "x", "y", *(f"v{i}" for i in range(6))])
        table.writerow([0.0, "idle", "", "", *[500.0] * 6])
        for number in range(1, 61):
            x, y = rng.uniform([0.01, 0.005], [0.11, 0.055])
            near = np.exp(-((centres - (x, y)) ** 2).sum(axis=1) / 0.03**2)
            values = 500.0 * (1 + 0.05 * near) + rng.normal(size=6) * 0.02
            table.writerow(
                [0.1 * number, "touch", f"{x:.6f}", f"{y:.6f}", *(f"{v:.4f}" for v in values)]
            )


def described(dataset: Dataset) -> dict[str, object]:
    """What a dataset holds: of every array type, shape and SHA-256 of its bytes."""
    found: dict[str, object] = {"arrays": {}}
    for field in fields(dataset):
        value = getattr(dataset, field.name)
        if isinstance(value, np.ndarray):
            digest = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
            found["arrays"][field.name] = [value.dtype.str, list(value.shape), digest]
    found["frequency"], found["source"], found["seed"] = (
        dataset.frequency,
        dataset.source,
        dataset.seed,
    )
    found["table"] = dataset.protocol and [list(row) for row in dataset.protocol.table]
    found["electrodes"] = dataset.design and [[e.x, e.y] for e in dataset.design.electrodes]
    return found


def perceived(pipeline: Pipeline, dataset: Dataset) -> dict[str, object]:
    """What each frame of a dataset shows by itself."""
    shown = pipeline.perceive(dataset)
    return {
        "probabilities": shown.probabilities.tolist(),
        "bend_angle_deg": shown.bend_angle_deg.tolist(),
        "touch_map_mean": shown.touch_map.mean(axis=(1, 2)).tolist(),
        "touches": [[list(t) for t in each.triples] for each in shown.touches],
    }


def session(pipeline: Pipeline, folder: Path) -> list[dict[str, object]]:
    """The estimates of the recording, frame by frame."""
    with open_board(f"replay:{folder}/recording") as board:
        return [estimated(pipeline.process(frame)) for frame in board.frames()]


def estimated(estimate) -> dict[str, object]:
    """An estimate as plain data."""
    return {
        "number": estimate.number,
        "state": estimate.state.name,
        "probabilities": estimate.probabilities.tolist(),
        "bend_angle_deg": estimate.bend_angle_deg,
        "touches": [list(touch) for touch in estimate.touches],
    }


def positions(folder: Path) -> list[list[float]]:
    """Positions found in the part of the presses that was not learned from."""
    learned = RecordedTouches.load(folder / "positions.eitmodel")
    return learned.found(open_dataset(folder / "presses"))[1].tolist()


def reference() -> dict[str, object]:
    """What the shipped pipeline, trained with 0.1, says of its own golden frames."""
    pipeline = Pipeline.load("reference.eitmodel")
    shown = pipeline.method.perceive(pipeline.examples)
    return {
        "state": shown.state.tolist(),
        "probabilities": shown.probabilities.tolist(),
        "bend_angle_deg": shown.bend_angle_deg.tolist(),
        "bend_deviation_deg": shown.bend_deviation_deg.tolist(),
        "touches": [[list(t) for t in each.triples] for each in shown.touches],
        "force": [each.force.tolist() for each in shown.touches],
    }


if __name__ == "__main__":
    main(Path(sys.argv[1]))
