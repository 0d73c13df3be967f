"""`eitskin bench paper`: its frames, its figures against known answers, its table and files."""

import dataclasses
import itertools
from collections import Counter, defaultdict
from typing import ClassVar

import numpy as np
import pytest
from command_line import printed_json
from touched_dataset import touched_dataset

from eitskin.benchmarks.paper import run as paper
from eitskin.benchmarks.paper import scores as paper_scores
from eitskin.benchmarks.paper.scores import KNOWN_DEG, Sets, recipes
from eitskin.benchmarks.results import read_results
from eitskin.datasets import Dataset, Recipe, State
from eitskin.datasets.recipe.frame_sampling import sample, specimen
from eitskin.geometry import Bend, SensorDesign
from eitskin.simulator import Protocol, Scene, Simulator, Touch
from eitskin.training import Pipeline, Predictions, TrainingSettings
from eitskin.training.evaluation.cramer_rao import scene_derivatives
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.method.interface import Adaptation, Calibration, Method
from eitskin.training.method.observations import Observations
from eitskin.training.method.targets import Targets

FLAT = np.linspace(400.0, 820.0, 28)
NOISE = 1e-4  # of a frame, relative
STRENGTH = 1e-2  # of a touch
SIGNAL = STRENGTH * np.where(np.arange(28) % 2, 1.0, -1.0)
BEND = 1e-3 * np.linspace(0.0, 2.0, 28)  # a degree; a step that all channels share is of the board
PLACES = [(0.02, 0.02), (0.06, 0.04), (0.09, 0.02), (0.13, 0.04)]
SETS: list[Dataset] = []


def dataset(frames, seed=0, episode=None):
    """Frames of one sensor, of (angle, number of touches); no two are alike."""
    rng = np.random.default_rng(seed)
    n = len(frames)
    angle, count = np.array(frames, float).T
    there = np.arange(4) < count[:, None]
    free = FLAT * (1 + angle[:, None] * BEND) * (1 + NOISE * rng.normal(size=(n, 28)) / 8**0.5)
    signal = (count > 0)[:, None] * SIGNAL + NOISE * rng.normal(size=(n, 28))
    made = touched_dataset(
        FLAT * (1 + angle[:, None] * BEND + signal),
        FLAT,
        [PLACES[:touches] for touches in count.astype(int)],
        touch_reference=free,
        state=np.where(count > 0, State.TOUCH, np.where(angle != 0, State.BEND, State.IDLE)),
        bend_angle_deg=angle,
        touch_force=np.where(there, 10.0, np.nan),
        touch_radius=np.where(there, 0.0075, np.nan),
        time=0.3 * np.arange(n),
        episode=np.arange(n) if episode is None else episode,
        protocol=Protocol.pairwise(8),
        design=SensorDesign.reference(),
        recipe='name = "by hand"\nreference_frames = 8\n',
        source="simulated",
    )
    SETS.append(made)
    return made


def experiments(seed):
    touches = [(0, 1), (30, 1), (20, 2), (10, 3), (30, 4)]
    sequence = [(0, 0), (10, 0), (20, 0)]
    demo = [(0, 0), (-10, 0), (-10, 2), (20, 3), (20, 3), (40, 4), (0, 4)]
    return {
        "indentation": dataset([(0, 1)] * 3, seed),
        "touch": dataset(touches, seed + 1),
        "states": dataset([(0, 0), (0, 0), (15, 0), (0, 1)], seed + 2),
        "bending": dataset([(-20, 0), (25, 0), (50, 0), *sequence], seed + 3, [0, 1, 2, 3, 3, 3]),
        "demo": dataset(demo, seed + 4, [0] * len(demo)),
    }


def made(_folder, seed, *_args):
    """Sets as `paper_sets.make` gives them, without simulating any."""
    known = dataset([(angle, 0) for angle in (0.0, *KNOWN_DEG)], 90)
    calibration = {"bending": known, "touch": known}
    own, unseen = experiments(10 * seed), experiments(10 * seed + 100)
    return Sets(known, own, unseen, calibration, Recipe.from_shipped("training"))


@dataclasses.dataclass
class Known(Method):
    """A method that knows every frame, and is wrong by as much as it is told."""

    targets: ClassVar[Targets] = Targets()
    fit = from_arrays = arrays = None
    place: float  # m, along x
    angle_deg: float
    spec: InputSpec

    def predict(self, observations):
        data = Dataset.concatenate(SETS)
        changes = data.impedance.real / FLAT - 1
        rows = [np.abs(changes - row).sum(axis=1).argmin() for row in observations.static]
        true = data.select(rows)
        return Predictions.from_arrays(
            len(rows),
            self.spec,
            probabilities=np.eye(3)[true.state],
            bend_angle_deg=true.bend_angle_deg + self.angle_deg,
            places=np.stack([true.touch_x + self.place, true.touch_y], axis=2),
        )

    def adapt(self, known):
        """Right to a tenth of what it was."""
        np.testing.assert_allclose(known.angle_deg[known.is_bent], KNOWN_DEG)
        better = dataclasses.replace(self, angle_deg=self.angle_deg / 10)
        return better, Adaptation(
            1, 5, calibration=Calibration(KNOWN_DEG, (1,) * 5, (0.1,) * 5, 0.1)
        )


def pipeline(place, angle_deg):
    layout = InputSpec(SensorDesign.reference(), Protocol.pairwise(8), 40e3, FLAT)
    said = {"frames": 7, "source": "simulated", "sha256": ""}
    examples = Observations.from_dataset(dataset([(0, 0)], 77))
    known = Known(place, angle_deg, layout)
    return Pipeline(layout, known, NOISE, TrainingSettings(), said, examples)


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """Folder that the command leaves behind for two seeds, and the rows that it prints."""
    out = tmp_path_factory.mktemp("paper")
    (out / "ours.eitmodel").mkdir()
    limits = {"indentation.error_mm": 0.5, "bend.angle_deg": 0.1}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper, "make", made)
        patch.setattr(paper, "_pipeline", lambda *_: pipeline(5e-3, 2.0))
        patch.setattr(paper.Pipeline, "load", lambda _path: pipeline(1e-3, 0.5))
        patch.setattr(paper_scores, "bounds", lambda *_args: limits)
        options = ("--pipeline", out / "ours.eitmodel", "--seeds", 2, "--out", out)
        printed = printed_json("bench", "paper", *options)
    return out / "paper", printed["rows"]


@pytest.mark.slow
def test_figures_are_what_the_pipelines_are_known_to_do(measured):
    folder, rows = measured
    by_run = defaultdict(dict)
    for row in rows:
        by_run[row["column"], row["seed"]][row["figure"]] = row["value"]
    columns = {paper.OWN: (5.0, 2.0), paper.UNSEEN: (5.0, 2.0), paper.OURS: (1.0, 0.5)}
    for (column, (millimetres, degrees)), seed in itertools.product(columns.items(), (0, 1)):
        figures = by_run[column, seed]
        for name in ("indentation", "touch.1", "touch.2", "touch.4", "touch"):
            assert figures[f"{name}.error_mm"] == pytest.approx(millimetres, rel=1e-4)
        for name in ("touch.4.found", "state.touch", "demo.state"):
            assert figures[name] == 1.0
        for name in ("bend", "touch", "sequence", "demo"):
            assert figures[f"{name}.angle_deg"] == pytest.approx(degrees, rel=1e-4)
        assert figures["touch.4.false"] == 0
        assert 0 < figures["time.p50_ms"] <= figures["time.p99_ms"]
    ours = by_run[paper.OURS, 0]
    assert ours["calibrated.angle_deg"] == pytest.approx(0.05, rel=1e-3)
    assert ours["calibrated.touched_deg"] == pytest.approx(0.05, rel=1e-3)
    assert "calibrated.angle_deg" not in by_run[paper.OWN, 0]
    assert read_results(folder / "results.json").figures[f"{paper.OURS}: touch.4.found"] == 100.0
    assert (folder / "paper-touches.png").is_file()


@pytest.mark.slow
def test_bounds_are_those_of_the_frames_scenes():
    """By hand: the noise is the instrument's, the reference of the recipe's number of frames."""
    recipe = dict(recipes(0, True))["unseen-touch"]
    sets = {
        "indentation": dataset([(0, 1)]),
        "touch": dataset([(20, 1)]),
        "bending": dataset([(30, 0)]),
    }
    found = paper_scores.bounds(sets, recipe, 5, seed=0)
    sim = Simulator(SensorDesign.reference(), "fast")
    touch = Touch(*(float(np.float32(v)) for v in PLACES[0]), 10.0)
    bent = scene_derivatives(sim, Scene(Bend(20.0), (touch,)))
    noise = bent.noise(recipe.instrument, sim.full_scale)
    expected = 1e3 * bent.bound(noise, 8).distance[0]
    assert found["touch.1.error_mm"] == pytest.approx(expected, rel=1e-6)
    assert found["touch.angle_deg"] == pytest.approx(bent.bound(noise, np.inf).angle_deg, rel=1e-6)
    free = scene_derivatives(sim, Scene(Bend(30.0)))
    expected = free.bound(free.noise(recipe.instrument, sim.full_scale), np.inf).angle_deg
    assert found["bend.angle_deg"] == pytest.approx(expected, rel=1e-6)


# Frames


def test_own_sensor_is_one_and_each_sensor_is_calibrated_by_one_frame_of_each_angle():
    whole = dict(recipes(0, quick=True))
    own = [specimen(whole[name], 0) for name in ("training", "own-touch", "own-bending")]
    assert own[0] == own[1] == own[2]
    assert own[0].design != SensorDesign.reference()
    assert specimen(whole["unseen-touch"], 0) != own[0]
    assert sample(whole["own-touch"], 3).scene != sample(whole["unseen-touch"], 3).scene
    for name in ("bending", "touch"):
        known, experiment = whole[f"calibration-{name}"], whole[f"unseen-{name}"]
        shown = [sample(known, index) for index in range(known.frames)]
        frames = Counter((each.specimen, each.scene.bend.angle_deg) for each in shown)
        assert set(frames.values()) == {1}
        assert len(frames) == 6 * experiment.specimens.count
        assert specimen(known, 0) == specimen(experiment, 0)
