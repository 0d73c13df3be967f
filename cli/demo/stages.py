"""The demo's stages in their order, from the bare sensor to a pipeline on a live board."""

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import RenderableType

from eitskin import datasets, hardware, training
from eitskin.cli.commands.generate import make_dataset
from eitskin.cli.commands.train import choose, paper_table, train_and_measure, train_positions
from eitskin.cli.demo.pictures import (
    Picture,
    as_pictures,
    episode_film,
    raw_frames,
    render_picture,
    touch_positions,
)
from eitskin.cli.options import Output, make_table
from eitskin.cli.page.commands import STEPS
from eitskin.datasets.recipe.recipe import Recipe, with_seed
from eitskin.datasets.recordings.recorded_file import RecordingNames
from eitskin.datasets.recordings.recording import read_recording
from eitskin.datasets.store.folder import make_folder, open_dataset
from eitskin.datasets.store.schema import State
from eitskin.errors import DataError, FrameError
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.protocol import Protocol
from eitskin.provenance import package_versions
from eitskin.simulator.scene.scene import Scene, Touch
from eitskin.simulator.simulator import Simulator
from eitskin.training.evaluation.drawing import CaptionedFigure
from eitskin.training.evaluation.evaluate import Evaluation, held_out_positions
from eitskin.training.evaluation.figures import draw_error_vectors, loss_curves
from eitskin.training.evaluation.report import PICTURES
from eitskin.training.evaluation.scores import match_distances
from eitskin.training.method.observations import fingerprint
from eitskin.training.method.targets import STATE_NAMES
from eitskin.training.pipeline.saved_form import SHIPPED_PATH as SHIPPED_MODEL
from eitskin.training.pipeline.saved_form import read_pipeline

PACKAGES = ("eitskin", "numpy", "scipy", "torch")
SETS = ("quick", "quick_test", "paper_indentation")
TRAINED, SHIPPED = "trained here", "shipped"
DRIVE = (0, 4)
SCENES = (
    ("touched with 10 N at two positions", Scene(touches=(Touch(0.04, 0.02), Touch(0.11, 0.04)))),
    ("bent by 40 deg", Scene(Bend(40.0))),
    (
        "bent by 40 deg and touched with 10 N at three positions",
        Scene(Bend(40.0), (Touch(0.030, 0.030), Touch(0.075, 0.020), Touch(0.120, 0.040))),
    ),
)
ALT = {
    "confusion": "Matrix of true against estimated states",
    "bend_angle": "Estimated over true bend angle, and the distribution of the errors",
    "touch_maps_angles": "Touch maps of one touch at several bend angles next to the truth",
    "touch_maps_counts": "Touch maps of one to four touches next to the truth",
    "error_vectors": "Lines on the sensor from true to estimated positions",
    "localisation_errors": "Histogram of the distances between true and estimated positions",
}
"""Pictures of an evaluation, and their alternative texts."""

COLUMNS = ("true", "state", "angle, deg", "touches: true", "estimated", "error, mm", "ms/frame")
"""Columns of the table of the live episode."""


@dataclass
class Stage:
    """Result of one stage: plain data, pictures by name, remarks next to them, a table."""

    numbers: Any
    pictures: dict[str, Picture] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    table: RenderableType | None = None


@dataclass
class Demo:
    """Folder of a demo, with its datasets and pipelines, made when they are first asked for.

    Attributes:
        out: the folder.
        data: folder of real recordings; None without them.
        workers: number of processes that simulate.
        output: place where progress and results are shown.
        seed: seed of everything random.
        recipes: recipes of the datasets for training, for tests and of touches on a grid, by the
            names in `SETS`; the shipped ones when omitted, with the grid on the finer mesh.
        epochs: passes over the frames in training, instead of the preset's.
        episode_frames: frames of each step of the live episode.
    """

    out: Path
    data: Path | None
    workers: int
    output: Output
    seed: int = 0
    recipes: Mapping[str, Recipe] = field(default_factory=dict)
    epochs: int | None = None
    episode_frames: int = 12

    def __post_init__(self) -> None:
        """Make the folder, and choose the recipes."""
        if not self.recipes:
            shipped = [Recipe.from_shipped(name) for name in SETS]
            *quick, grid = [with_seed(each, each.seed + self.seed) for each in shipped]
            grid = dataclasses.replace(grid, resolution="standard")
            self.recipes = dict(zip(SETS, (*quick, grid), strict=True))
        self.model, self.design = self.out / "demo.eitmodel", self.recipes["quick"].sensor
        make_folder(self.out)

    @cached_property
    def sets(self) -> "dict[str, datasets.Dataset]":
        """Datasets by name; finished shards are kept."""
        for name, recipe in self.recipes.items():
            folder = self.out / name
            _, sentence = make_dataset(recipe, folder, self.workers, folder.exists(), self.output)
            self.output.show(sentence)
        return {name: open_dataset(self.out / name) for name in self.recipes}

    def pipeline(self, which: str) -> "training.Pipeline":
        """Saved pipeline `TRAINED`, trained where that is needed, or `SHIPPED`."""
        if which == TRAINED and not self.is_trained():
            start = time.perf_counter()
            choice = choose("quick", epochs=self.epochs, seed=self.seed)
            trained = train_and_measure(self.sets["quick"], choice, self.output).pipeline
            seconds = round(time.perf_counter() - start, 1)
            trained.metrics["training"] = {"made_from": self._training_inputs, "seconds": seconds}
            self.output.show(f"saved pipeline: {trained.save(self.model)}")
        return training.Pipeline.load(self.model if which == TRAINED else SHIPPED_MODEL)

    def is_trained(self) -> bool:
        """Whether the saved pipeline was trained on the same frames in the same way."""
        try:
            metrics = read_pipeline(self.model).document["metrics"]
        except DataError:
            return False
        return bool(metrics.get("training", {}).get("made_from") == self._training_inputs)

    @cached_property
    def _training_inputs(self) -> dict[str, Any]:
        """Everything that the trained pipeline depends on."""
        versions, frames = package_versions(PACKAGES), fingerprint(self.sets["quick"])
        return {"versions": versions, "seed": self.seed, "frames": frames, "epochs": self.epochs}


def show_sensor(demo: Demo) -> Stage:
    """The flat sensor: electrodes, mesh, potential and current, and its resistances."""
    from eitskin.simulator.view.scene_pictures import draw_drive, model_for_pictures

    design, model = demo.design, model_for_pictures(demo.design)
    resistance = Simulator(design, "fast").measure(Scene()).impedance.real
    numbers = {
        "length_mm": 1e3 * design.outline.length,
        "width_mm": 1e3 * design.outline.width,
        "thickness_mm": 1e3 * design.thickness,
        "electrodes": len(design.electrodes),
        "resistances": len(resistance),
        "smallest_ohm": float(resistance.min()),
        "largest_ohm": float(resistance.max()),
    }
    caption = (
        f"The gel from the front with its {len(design.electrodes)} electrodes, the "
        f"{len(model.mesh.cells)} cells of the picture's mesh, and the field of a current of 1 A "
        f"from electrode {DRIVE[0]} to {DRIVE[1]}: potential with lines of equal potential, lines "
        "of current, and current density where it is largest, at the edges of an electrode. "
        "Meshes for measurements are graded more finely."
    )
    alt = "Sensor with numbered electrodes, its mesh, potential and current"
    drawn = render_picture(partial(draw_drive, model, DRIVE), alt, caption, 10.0)
    return Stage(numbers, {"sensor": drawn})


def show_scenes(demo: Demo) -> Stage:
    """The sensor in three scenes, and the change of its resistances."""
    from eitskin.simulator.view.scene_pictures import draw_scenes

    sim = Simulator(demo.design, "fast")
    flat = sim.measure(Scene()).impedance.real
    scenes = []
    for title, scene in SCENES:
        change = 100.0 * (sim.measure(scene).impedance.real / flat - 1.0)
        scenes.append({"scene": title, "rms_percent": float(np.sqrt(np.mean(change**2)))})
    caption = (
        "Three scenes to one scale. Colours: change of the conductance along the sensor, which "
        "falls under a touch and where the bend stretches the gel; rings next to a touch are gel "
        "that was pushed aside."
    )
    alt = "The sensor " + "; ".join(title for title, _ in SCENES)
    drawn = render_picture(partial(draw_scenes, sim, SCENES), alt, caption, 6.4)
    return Stage({"scenes": scenes}, {"scenes": drawn})


def make_sets(demo: Demo) -> Stage:
    """Contents of every dataset; touches and frames of the first as pictures."""
    numbers = {}
    for name, data in demo.sets.items():
        angles = data.bend_angle_deg[data.state != State.IDLE]
        numbers[name] = {
            "frames": len(data),
            "seed": data.seed,
            "resolution": demo.recipes[name].resolution,
            "snr_db": demo.recipes[name].instrument.snr_db,
            "states": {state.name.lower(): int(np.sum(data.state == state)) for state in State},
            "touches": int(data.touch_count.sum()),
            "smallest_angle_deg": float(angles.min(initial=0.0)),
            "largest_angle_deg": float(angles.max(initial=0.0)),
        }
    name, data = next(iter(demo.sets.items()))
    pictures = as_pictures(
        positions=(touch_positions(data, name), "Positions of the touches on the sensor"),
        frames=(raw_frames(data, name), "Raw frames: changes of all resistances"),
    )
    return Stage(numbers, pictures)


def train(demo: Demo) -> Stage:
    """Duration and frames of the training, and its losses."""
    pipeline = demo.pipeline(TRAINED)
    seconds = pipeline.metrics["training"]["seconds"]
    losses = (loss_curves(pipeline), "Loss over the epochs of each network")
    numbers = {"frames": pipeline.trained_on["frames"], "seconds": seconds}
    return Stage(numbers, as_pictures(losses=losses))


def evaluate(which: str, frames: str, demo: Demo) -> Stage:
    """Figures of `eitskin evaluate`, and the pictures of its report."""
    evaluation = Evaluation.from_dataset(demo.pipeline(which), demo.sets[frames])
    drawn = {name: (PICTURES[f"{name}.png"](evaluation), alt) for name, alt in ALT.items()}
    numbers, table = evaluation.report.as_dict(), paper_table(evaluation.report)
    return Stage(numbers, as_pictures(**drawn), table=table)


def go_live(demo: Demo) -> Stage:
    """The paper's episode on a virtual board."""
    rows = run_episode(demo.pipeline(TRAINED), demo.seed, demo.episode_frames)
    angles = np.concatenate([row["angles_deg"] for row in rows])
    true = np.repeat([row["true_angle_deg"] for row in rows], [len(row["states"]) for row in rows])
    errors = [error for row in rows for error in row["errors_mm"]]
    latencies = [time for row in rows for time in row["latencies_ms"]]
    p50, p99 = np.percentile(latencies, [50, 99]).tolist()
    numbers = {
        "frames": len(angles),
        "right_states": sum(row["right_frames"] for row in rows),
        "angle_rmse_deg": float(np.sqrt(np.mean((angles - true) ** 2))),
        "touches": sum(len(row["true_touches_mm"]) for row in rows),
        "touches_found": len(errors),
        "mean_error_mm": float(np.mean(errors)) if errors else None,
        "latency": {"p50_ms": p50, "p99_ms": p99},
        "steps": rows,
    }
    alt = "Moving picture of the live episode: the sensor as estimated, next to the truth"
    caption = (
        "The sensor as the pipeline estimates it: bent by the estimated angle, coloured by the "
        "estimated state, dented and with discs at the detected touches. Dashed lines and rings: "
        "the truth. Below, the estimated angle of every frame (dots) and the true one (line)."
    )
    film = Picture.from_webp(alt, caption, episode_film(rows, demo.design), 6.5)
    return Stage(numbers, {"film": film}, table=make_table(COLUMNS, map(episode_cells, rows)))


def run_episode(pipeline: "hardware.FramePipeline", seed: int, frames: int) -> list[dict[str, Any]]:
    """Play the episode through a virtual board and `pipeline`; one row of results per step.

    Every frame comes as packets, as from a real board. A row holds the state estimated in most
    frames of its step, the median angle, the touches of the last frame, and state, angle, touches
    and time of each frame.
    """
    script = hardware.Script(tuple(hardware.Step(scene, frames) for scene in STEPS), repeat=False)
    with hardware.open_board("virtual:", scene=script, speed="max", seed=seed) as board:
        live = hardware.run_live(board, pipeline, newest=False)
        return [_episode_row(scene, list(islice(live, frames))) for scene in STEPS]


def _episode_row(scene: Scene, readings: "Sequence[hardware.Reading]") -> dict[str, Any]:
    estimates = [reading.estimate for reading in readings if reading.estimate is not None]
    names = [str(getattr(estimate.state, "name", estimate.state)).lower() for estimate in estimates]
    truth = "touch" if scene.touches else "bend" if scene.bend.angle_deg else "idle"
    true = [(touch.x, touch.y) for touch in scene.touches]
    places = [[(float(x), float(y)) for x, y, _ in each.touches or ()] for each in estimates]
    errors = match_distances(true, places[-1]) if true else []
    angles = [np.nan if e.bend_angle_deg is None else e.bend_angle_deg for e in estimates]
    latencies = [1e3 * float(reading.latency) for reading in readings]
    return {
        "true_state": truth,
        "state": max(STATE_NAMES, key=names.count),
        "right_frames": names.count(truth),
        "true_angle_deg": scene.bend.angle_deg,
        "angle_deg": float(np.median(angles)),
        "true_touches_mm": _millimetres(true),
        "touches_mm": _millimetres(places[-1]),
        "errors_mm": [1e3 * float(error) for error in errors],
        "latency_ms": float(np.median(latencies)),
        "states": names,
        "angles_deg": angles,
        "found_mm": [_millimetres(place) for place in places],
        "latencies_ms": latencies,
    }


def _millimetres(places: Sequence[tuple[float, float]]) -> list[list[float]]:
    return [[1e3 * x, 1e3 * y] for x, y in places]


def episode_cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    """Cells of a step's row: truth and estimate, one text for each of `COLUMNS`."""
    true, estimated = (
        " ".join(f"({x:.0f},{y:.0f})" for x, y in row[name]) or "-"
        for name in ("true_touches_mm", "touches_mm")
    )
    return (
        row["true_state"],
        f"{row['state']} ({row['right_frames']}/{len(row['states'])})",
        f"{row['angle_deg']:+.1f} (true {row['true_angle_deg']:+.0f})",
        true,
        estimated,
        ", ".join(f"{error:.1f}" for error in row["errors_mm"]) or "-",
        f"{row['latency_ms']:.1f}",
    )


def read_recordings(demo: Demo) -> Stage:
    """Touch positions learned from real presses, and a frame of a real board."""
    stage = Stage({})
    for file, measure in (("ohmc8.mat", _presses), ("openeit_background_8.txt", _board_frame)):
        path = (demo.data or Path()) / file
        if demo.data is not None and path.is_file():
            stage.remarks += (f"{file}: {measure(demo, path, stage)}",)
        else:
            folder = demo.data or "the folder that --data names"
            missing = f"{file}: not found in {folder}; give the folder that holds it as --data"
            stage.remarks += (missing,)
    return stage


def _presses(demo: Demo, path: Path, stage: Stage) -> str:
    """500 robot presses on a round hydrogel skin of 32 channels."""
    recording = read_recording(path, RecordingNames("responsedowns", "responseups", "positions"))
    learned, _ = train_positions(recording)
    learned.save(demo.out / "presses.eitmodel")
    score = learned.metrics
    stage.numbers["presses"] = {"presses": len(recording), **score}
    true, places = held_out_positions(learned, recording)
    figure = draw_error_vectors(None, true, places.place).figure
    caption = (
        f"{path.name}: the last {len(true)} touches by a robot on a real, round hydrogel skin, "
        "left out of the training; to scale. Lines from true to estimated positions."
    )
    drawn = CaptionedFigure(figure, caption)
    stage.pictures |= as_pictures(presses=(drawn, "True and estimated positions of real presses"))
    return (
        f"{len(recording)} presses, learned from the first 80 % in time: mean error "
        f"{score['mean_error_mm']:.1f} mm on the last {score['frames']} (published with the "
        f"data: 4.5 mm; always the middle: {score['guess_error_mm']:.0f} mm)"
    )


def _board_frame(demo: Demo, path: Path, stage: Stage) -> str:
    """One frame of all 28 pairs of a real board, given to the pipeline."""
    recording = read_recording(path, protocol=Protocol.pairwise(8))
    pipeline = demo.pipeline(TRAINED)
    ratio = float(np.median(np.abs(recording.impedance[0]) / pipeline.layout.reference))
    try:
        verdict = "; ".join(pipeline.process(recording.frame(0)).problems) or "accepted"
    except FrameError as error:
        verdict = f"the pipeline refuses it: {error}"
    stage.numbers["board_frame"] = {"median_ratio": ratio}
    return (
        f"{verdict}. Its values are {ratio:.3g} times those of the sensor that the pipeline was "
        "trained for, in the median."
    )


STAGES: dict[str, tuple[str, Callable[[Demo], Stage]]] = {
    "sensor": ("The sensor", show_sensor),
    "states": ("Bent and touched", show_scenes),
    "sets": ("Training and test frames", make_sets),
    "training": ("Training", train),
    "test": (
        "Trained here: other frames, of a finer mesh",
        partial(evaluate, TRAINED, "quick_test"),
    ),
    "indentation": ("Trained here: 27 positions", partial(evaluate, TRAINED, "paper_indentation")),
    "shipped": (
        "Pretrained pipeline: the same frames",
        partial(evaluate, SHIPPED, "quick_test"),
    ),
    "shipped_indentation": (
        "Pretrained pipeline: 27 positions",
        partial(evaluate, SHIPPED, "paper_indentation"),
    ),
    "live": ("The saved pipeline, unchanged, on a virtual board over a serial link", go_live),
    "real": ("Real recordings", read_recordings),
}
"""Heading and work of all stages, in their order, by the name that their numbers have."""
