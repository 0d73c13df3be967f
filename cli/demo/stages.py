"""The demo's stages in their order, from the bare sensor to a pipeline on a live board."""

import dataclasses
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import RenderableType

from eitskin.cli.commands.evaluate import paper_table
from eitskin.cli.commands.generate import make_dataset
from eitskin.cli.commands.train import choose, train_and_measure, train_positions
from eitskin.cli.demo.live_episode import FRAMES, episode_film, episode_table, run_episode
from eitskin.cli.demo.pictures import (
    Picture,
    as_pictures,
    raw_frames,
    rendered,
    touch_positions,
)
from eitskin.cli.options import Output
from eitskin.datasets.recipe.recipe import Recipe, with_seed
from eitskin.datasets.recordings.recorded_file import RecordingNames
from eitskin.datasets.recordings.recording import read_recording
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.folder import make_folder, open_dataset
from eitskin.datasets.store.schema import State
from eitskin.errors import DataError, FrameError
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.protocol import Protocol
from eitskin.simulator.scene.scene import Scene, Touch
from eitskin.simulator.simulator import Simulator
from eitskin.training.evaluation.drawing import CaptionedFigure
from eitskin.training.evaluation.evaluate import Evaluation
from eitskin.training.evaluation.figures import draw_error_vectors, loss_curves
from eitskin.training.evaluation.position_score import held_out_positions
from eitskin.training.evaluation.report import PICTURES
from eitskin.training.evaluation.scores import percentiles
from eitskin.training.method.observations import fingerprint
from eitskin.training.pipeline.saved_form import SHIPPED as SHIPPED_MODEL
from eitskin.training.pipeline.saved_form import read_pipeline

if TYPE_CHECKING:
    from eitskin.training.pipeline.pipeline import Pipeline

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
    "touch_maps_angles": "Touch maps of one touch at several bend angles beside the truth",
    "touch_maps_counts": "Touch maps of one to four touches beside the truth",
    "error_vectors": "Lines on the sensor from true to estimated positions",
    "localisation_errors": "Histogram of the distances between true and estimated positions",
}
"""Pictures of an evaluation, and their alternative texts."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Choices that a demo is made by.

    Attributes:
        recipes: of the datasets for training, for tests and of touches on a grid, as `SETS`.
        seed: of everything random.
        epochs: passes over the frames in training, instead of the preset's.
        episode_frames: frames of each step of the live episode.
    """

    recipes: Mapping[str, Recipe]
    seed: int = 0
    epochs: int | None = None
    episode_frames: int = FRAMES

    @classmethod
    def standard(cls, seed: int) -> "Plan":
        """Plan of `make demo`: the shipped recipes, test frames from the finer mesh."""
        recipes = {name: Recipe.shipped(name) for name in SETS}
        seeded = {name: with_seed(each, each.seed + seed) for name, each in recipes.items()}
        grid = dataclasses.replace(seeded["paper_indentation"], resolution="standard")
        return cls(seeded | {"paper_indentation": grid}, seed)


@dataclass
class Stage:
    """Result of one stage: plain data, pictures by name, remarks beside them, a table."""

    numbers: Any
    pictures: dict[str, Picture] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    table: RenderableType | None = None


class Demo:
    """Folder of a demo, with its datasets and pipelines, made when they are first asked for."""

    def __init__(
        self, plan: Plan, out: Path, data: Path | None, workers: int, output: Output
    ) -> None:
        """Make the folder `out`; real recordings are in the folder `data`."""
        self.plan, self.out, self.data = plan, out, data
        self.workers, self.output = workers, output
        self.model = out / "demo.eitmodel"
        self.design = plan.recipes["quick"].sensor
        make_folder(out)

    @cached_property
    def sets(self) -> dict[str, Dataset]:
        """Datasets by name; finished shards are kept."""
        for name, recipe in self.plan.recipes.items():
            folder = self.out / name
            _, sentence = make_dataset(recipe, folder, self.workers, folder.exists(), self.output)
            self.output.show(sentence)
        return {name: open_dataset(self.out / name) for name in self.plan.recipes}

    def pipeline(self, which: str) -> "Pipeline":
        """Saved pipeline `TRAINED`, trained where that is needed, or `SHIPPED`."""
        from eitskin.training.pipeline.pipeline import Pipeline

        if which == TRAINED and not self.is_trained():
            start = time.perf_counter()
            choice = choose("quick", epochs=self.plan.epochs, seed=self.plan.seed)
            trained = train_and_measure(self.sets["quick"], choice, self.output).pipeline
            seconds = round(time.perf_counter() - start, 1)
            trained.metrics["training"] = {"made_from": self._made_from, "seconds": seconds}
            self.output.show(f"saved pipeline: {trained.save(self.model)}")
        return Pipeline.load(self.model if which == TRAINED else SHIPPED_MODEL)

    def is_trained(self) -> bool:
        """Whether the saved pipeline was trained on the same frames in the same way."""
        try:
            metrics = read_pipeline(self.model).document["metrics"]
        except DataError:
            return False
        return bool(metrics.get("training", {}).get("made_from") == self._made_from)

    @cached_property
    def _made_from(self) -> dict[str, Any]:
        """Everything that the trained pipeline depends on."""
        plan, frames = self.plan, fingerprint(self.sets["quick"])
        return {"versions": versions(), "seed": plan.seed, "frames": frames, "epochs": plan.epochs}


def versions() -> dict[str, str]:
    """Versions of the packages that the numbers depend on."""
    return {name: version(name) for name in PACKAGES}


def show_sensor(demo: Demo) -> Stage:
    """The flat sensor: electrodes, mesh, potential and current, and its resistances."""
    from eitskin.simulator.view.model_pictures import draw_drive, model_for_pictures

    design, model = demo.design, model_for_pictures(demo.design)
    resistance = Simulator(design, "fast").measure(Scene()).impedance.real
    electrodes, cells = len(design.electrodes), len(model.mesh.cells)
    numbers = {
        "length_mm": 1e3 * design.outline.length,
        "width_mm": 1e3 * design.outline.width,
        "thickness_mm": 1e3 * design.thickness,
        "electrodes": electrodes,
        "resistances": len(resistance),
        "smallest_ohm": float(resistance.min()),
        "largest_ohm": float(resistance.max()),
    }
    caption = (
        f"The gel from the front with its {electrodes} electrodes, the {cells} cells of the "
        f"picture's mesh, and the field of a current of 1 A from electrode {DRIVE[0]} to "
        f"{DRIVE[1]}: potential with lines of equal potential, lines of current, and current "
        "density where it is largest, at the edges of an electrode. Meshes for measurements are "
        "graded more finely."
    )
    alt = "Sensor with numbered electrodes, its mesh, potential and current"
    drawn = rendered(partial(draw_drive, model, DRIVE), alt, caption, 10.0)
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
        "falls under a touch and where the bend stretches the gel; rings beside a touch are gel "
        "that was pushed aside."
    )
    alt = "The sensor " + "; ".join(title for title, _ in SCENES)
    drawn = rendered(partial(draw_scenes, sim, SCENES), alt, caption, 6.4)
    return Stage({"scenes": scenes}, {"scenes": drawn})


def make_sets(demo: Demo) -> Stage:
    """Contents of every dataset; touches and frames of the first as pictures."""
    first, data = next(iter(demo.sets.items()))
    pictures = as_pictures(
        positions=(touch_positions(data, first), "Positions of the touches on the sensor"),
        frames=(raw_frames(data, first), "Raw frames: changes of all resistances"),
    )
    numbers = {name: _contents(demo.sets[name], demo.plan.recipes[name]) for name in demo.sets}
    return Stage(numbers, pictures)


def _contents(data: Dataset, recipe: Recipe) -> dict[str, Any]:
    angles = data.bend_angle_deg[data.state != State.IDLE]
    return {
        "frames": len(data),
        "seed": data.seed,
        "resolution": recipe.resolution,
        "snr_db": recipe.instrument.snr_db,
        "states": {state.name.lower(): int(np.sum(data.state == state)) for state in State},
        "touches": int(data.touch_count.sum()),
        "smallest_angle_deg": float(angles.min(initial=0.0)),
        "largest_angle_deg": float(angles.max(initial=0.0)),
    }


def train(demo: Demo) -> Stage:
    """Duration and frames of the training, and its losses."""
    pipeline = demo.pipeline(TRAINED)
    seconds = pipeline.metrics["training"]["seconds"]
    numbers = {"frames": pipeline.trained_on["frames"], "seconds": seconds}
    losses = (loss_curves(pipeline), "Loss over the epochs of each network")
    return Stage(numbers, as_pictures(losses=losses))


def evaluate(which: str, frames: str, demo: Demo) -> Stage:
    """Figures of `eitskin evaluate`, and the pictures of its report."""
    evaluation = Evaluation.of(demo.pipeline(which), demo.sets[frames])
    drawn = {name: (PICTURES[f"{name}.png"](evaluation), alt) for name, alt in ALT.items()}
    numbers, table = evaluation.report.as_dict(), paper_table(evaluation.report)
    return Stage(numbers, as_pictures(**drawn), table=table)


def go_live(demo: Demo) -> Stage:
    """The paper's episode on a virtual board."""
    rows = run_episode(demo.pipeline(TRAINED), demo.plan.seed, demo.plan.episode_frames)
    angles = np.concatenate([row["angles_deg"] for row in rows])
    true = np.repeat([row["true_angle_deg"] for row in rows], [len(row["states"]) for row in rows])
    errors = [error for row in rows for error in row["errors_mm"]]
    p50, p99 = percentiles([time for row in rows for time in row["latencies_ms"]])
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
    alt = "Moving picture of the live episode: the sensor as estimated, beside the truth"
    caption = (
        "The sensor as the pipeline estimates it: bent by the estimated angle, coloured by the "
        "estimated state, dented and with discs where it finds touches. Dashed lines and rings: "
        "the truth. Below, the estimated angle of every frame (dots) and the true one (line)."
    )
    film = Picture.of_webp(alt, caption, episode_film(rows, demo.design), 6.5)
    return Stage(numbers, {"film": film}, table=episode_table(rows))


def read_recordings(demo: Demo) -> Stage:
    """Touch positions learned from real presses, and a frame of a real board."""
    joined = Stage({})
    for file, measure in (("ohmc8.mat", _presses), ("openeit_background_8.txt", _board_frame)):
        if demo.data is not None and (demo.data / file).is_file():
            measure(demo, demo.data / file, joined)
        else:
            folder = demo.data if demo.data is not None else "the folder that --data names"
            missing = f"{file}: not found in {folder}; give the folder that holds it as --data"
            joined.remarks += (missing,)
    return joined


def _presses(demo: Demo, path: Path, joined: Stage) -> None:
    """500 robot presses on a round hydrogel skin of 32 channels."""
    recording = read_recording(path, RecordingNames("responsedowns", "responseups", "positions"))
    learned = train_positions(recording)
    learned.save(demo.out / "presses.eitmodel")
    score = learned.metrics
    joined.numbers["presses"] = {"presses": len(recording), **score}
    joined.remarks += (
        f"{path.name}: {len(recording)} presses, learned from the first 80 % in time: mean error "
        f"{score['mean_error_mm']:.1f} mm on the last {score['frames']} (published beside the "
        f"data: 4.5 mm; always the middle: {score['guess_error_mm']:.0f} mm)",
    )
    true, found = held_out_positions(learned, recording)
    figure = draw_error_vectors(None, true, true, found, true[:0]).figure
    caption = (
        f"{path.name}: the last {len(true)} presses of a robot on a real, round hydrogel skin, "
        "left out of the training; to scale. Lines from true to estimated positions."
    )
    drawn = CaptionedFigure(figure, caption)
    joined.pictures |= as_pictures(presses=(drawn, "True and estimated positions of real presses"))


def _board_frame(demo: Demo, path: Path, joined: Stage) -> None:
    """One frame of all 28 pairs of a real board, given to the pipeline."""
    recording = read_recording(path, protocol=Protocol.pairwise(8))
    pipeline = demo.pipeline(TRAINED)
    ratio = float(np.median(np.abs(recording.impedance[0]) / pipeline.layout.reference))
    try:
        verdict = "; ".join(pipeline.process(recording.frame(0)).problems) or "accepted"
    except FrameError as error:
        verdict = f"the pipeline refuses it: {error}"
    joined.numbers["board_frame"] = {"median_ratio": ratio}
    joined.remarks += (
        f"{path.name}: {verdict}. Its values are {ratio:.3g} times those of the sensor that the "
        "pipeline was trained for, in the median.",
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
        "Comes with eitskin: the same frames",
        partial(evaluate, SHIPPED, "quick_test"),
    ),
    "shipped_indentation": (
        "Comes with eitskin: 27 positions",
        partial(evaluate, SHIPPED, "paper_indentation"),
    ),
    "live": ("The saved pipeline, unchanged, on a virtual board over a serial link", go_live),
    "real": ("Real recordings", read_recordings),
}
"""Heading and work of all stages, in their order, by the name that their numbers have."""
