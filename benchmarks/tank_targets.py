"""Regions of targets in a water tank, next to those of pyEIT: `eitskin bench tank DATA`.

DATA is the folder of the Kuopio Tomography Challenge 2023 (Zenodo 8252370): `TrainingData` with
ref.mat and data1.mat to data4.mat, `GroundTruths` with true1.mat to true4.mat, both in DATA or in
its `Codes_Python`, and, where it is there, `EvaluationData`, whose levels 1 to 7 have ever fewer
electrodes. The files have no licence to be copied: figures and pictures are all that leaves them.

Regularisations are chosen on the four training targets. Regions of all pictures are found by the
same thresholds. The score is the challenge's: the mean over both classes of the structural
similarity of truth and regions, with a Gaussian of 80 pixels.
"""

import itertools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from eitskin.benchmarks.results import Report, ReportTable, Watch, make_results
from eitskin.datasets import RecordingForm, read_recording
from eitskin.extras import require
from eitskin.geometry import DataError, SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh import Mesh
from eitskin.simulator import ForwardModel, Protocol
from eitskin.simulator.electrical.resolution import Discretisation
from eitskin.training import PixelGrid, Reconstructor, Regularisation
from eitskin.training.reconstruction.pixel_grid import segment
from eitskin.training.reconstruction.reconstructor import REGION_METHOD, REGION_RULE, Method

Array = NDArray[np.float64]
Classes = NDArray[np.int8]

TANK = Path(__file__).parents[1] / "docs" / "how-to" / "recordings" / "water-tank.toml"
RULES: Mapping[Method, tuple[str, ...]] = {
    "laplace": ("snr:100", "snr:200", "snr:300", "snr:500", "noise-figure:1"),
    "greit": ("noise-figure:0.2", "noise-figure:0.3", "noise-figure:0.5", "noise-figure:1"),
}
LAMBDAS = (1e-2, 1e-1, 1.0, 10.0)  # of pyEIT, times the mean diagonal of J^T J or J J^T
MESH: Discretisation = ((1,), Grading(finest=6e-3, coarsest=8e-3, growth=1.0))  # of pyEIT
POWER = 0.5  # of the diagonal of pyEIT's prior, as in its examples
DEFAULT = f"eitskin {REGION_METHOD}", REGION_RULE  # of `eitskin reconstruct --segment`
TRAINING = "training"
SIDE, DEVIATION = 256, 80.0  # of the truth, and of the Gaussian of scores [pixels]
TRUNCATION = 2.0  # of that Gaussian [standard deviations]
STABILITY = 1e-4, 9e-4  # constants of the structural similarity


class Target(NamedTuple):
    """Frame of a target, with its truth.

    Attributes:
        group: "training" or "level 1" to "level 7".
        values: values (measurements,), NaN where lost.
        reference: the same of the tank without a target.
        truth: classes (256, 256), -1 where resistive and +1 where conductive, y upwards.
    """

    group: str
    values: Array
    reference: Array
    truth: Classes


Pictures = Callable[[Array, Array], Array]
"""Pictures (n, rows, columns) of values and references (n, measurements)."""


def run(folder: Path, quick: bool, watch: Watch = lambda _, items: items) -> Report:
    """Score the targets in a folder; quickly without levels.

    Raises DataError where a file is missing.
    """
    began = time.perf_counter()
    protocol, targets = read_targets(folder, quick)
    training = [target for target in targets if target.group == TRAINING]
    design = SensorDesign.from_toml(TANK)
    grid = PixelGrid.from_outline(design.outline)
    ways = dict(_ways(design, protocol, grid))
    tried = {
        way: score_pictures(ways[way], training, grid)[1] for way in watch("training", list(ways))
    }
    chosen = {
        name: max((way for way in tried if way[0] == name), key=lambda way: np.mean(tried[way]))
        for name, _ in tried
    }
    chosen["eitskin --segment"] = DEFAULT
    results = {
        name: score_pictures(ways[chosen[name]], targets, grid)
        for name in watch("levels", list(chosen))
    }
    groups = list(dict.fromkeys(target.group for target in targets))
    means = {
        name: [
            float(np.mean([s for s, t in zip(scores, targets, strict=True) if t.group == group]))
            for group in groups
        ]
        for name, (_, scores) in results.items()
    }
    figures = [
        (f"{name} / {group} / score", value)
        for name, values in means.items()
        for group, value in zip(groups, values, strict=True)
    ]
    return Report(
        results=make_results("tank", figures, began=began, quick=quick, options="DATA"),
        rows=[
            {"method": name, "setting": setting, "score": float(np.mean(scores))}
            for (name, setting), scores in tried.items()
        ],
        tables=[
            ReportTable(
                ("score", "chosen on training", *groups),
                [(k, chosen[k][1], *(f"{value:.3f}" for value in v)) for k, v in means.items()],
            )
        ],
        plots={
            f"{group.replace(' ', '-')}.png": partial(
                draw_targets,
                targets=[target for target in targets if target.group == group],
                columns={
                    name: pictures[[target.group == group for target in targets]]
                    for name, (pictures, _) in results.items()
                },
                grid=grid,
            )
            for group in groups
        },
    )


def score_pictures(
    pictures: Pictures, targets: Sequence[Target], grid: PixelGrid
) -> tuple[Array, list[float]]:
    """Pictures (n, rows, columns) of targets, and their scores."""
    found = pictures(*(np.array([target[k] for target in targets]) for k in (1, 2)))
    return found, [score(t.truth, segment(p, grid)) for t, p in zip(targets, found, strict=True)]


def read_targets(folder: Path, quick: bool) -> tuple[Protocol, list[Target]]:
    """Protocol and targets of a folder; raises DataError where training targets are missing."""
    inner = folder / "Codes_Python" if (folder / "Codes_Python").is_dir() else folder
    files = [
        (TRAINING, inner / f"TrainingData/data{k}.mat", inner / f"GroundTruths/true{k}.mat")
        for k in range(1, 5)
    ]
    for path in itertools.chain(*(each[1:] for each in files)):
        if not path.is_file():
            raise DataError(
                f"{path} is not there; name the folder of the Kuopio Tomography Challenge 2023, "
                "with TrainingData and GroundTruths in it"
            )
    evaluation = folder / "EvaluationData"
    for level, k in itertools.product(() if quick else range(1, 8), range(1, 4)):
        data = evaluation / f"evaluation_datasets/level{level}/data{k}.mat"
        if data.is_file():
            truth = evaluation / f"GroundTruths/level_{level}/{k}_true.mat"
            files.append((f"level {level}", data, truth))
    targets = []
    for group, path, truth in files:
        protocol, values = tank_frame(path)
        _, reference = tank_frame(path.parent / "ref.mat")
        classes = np.array([0, -1, 1], np.int8)[np.rint(loadmat(truth)["truth"]).astype(int)]
        targets.append(Target(group, values, reference, classes[::-1]))
    return protocol, targets


def tank_frame(path: Path) -> tuple[Protocol, Array]:
    """Protocol and values (measurements,) of the one frame of a file, NaN where lost."""
    recording = read_recording(path, form=RecordingForm(bad_values="mark"))
    if recording.protocol is None:
        raise DataError(f"expected patterns of currents and voltages in {path}, got none")
    return recording.protocol, np.where(
        recording.status[0] != 0, np.nan, recording.impedance[0].real.astype(float)
    )


def score(truth: Classes, regions: Classes) -> float:
    """Score of regions (rows, columns) against the truth (256, 256), 1 where they are the same."""
    rows, columns = ((np.arange(SIDE) * n) // SIDE for n in regions.shape)
    seen = regions[np.ix_(rows, columns)]
    return float(np.mean([similarity(truth == sign, seen == sign) for sign in (-1, 1)]))


def similarity(truth: NDArray[np.bool_], seen: NDArray[np.bool_]) -> float:
    """Mean structural similarity (Wang et al. 2004) of two masks, with a Gaussian window."""

    def mean(values: NDArray[Any]) -> Array:
        smooth = partial(gaussian_filter, sigma=DEVIATION, truncate=TRUNCATION, mode="constant")
        return np.asarray(smooth(values.astype(float)) / smooth(np.ones(values.shape)))

    first, second = mean(truth), mean(seen)
    # A mask is its own square.
    variances = first - first**2 + second - second**2
    covariance = mean(truth & seen) - first * second
    ratio = (2 * first * second + STABILITY[0]) * (2 * covariance + STABILITY[1])
    ratio /= (first**2 + second**2 + STABILITY[0]) * (variances + STABILITY[1])
    return float(ratio.mean())


def _ways(
    design: SensorDesign, protocol: Protocol, grid: PixelGrid
) -> Iterator[tuple[tuple[str, str], Pictures]]:
    """Pictures by name and setting: by methods of this package, and by pyEIT's."""
    for method, rules in RULES.items():
        first = Reconstructor(design, protocol, method, difference="absolute")
        for rule in rules:
            own = partial(_own_pictures, first, Regularisation.from_text(rule))
            yield (f"eitskin {method}", rule), own
    mesh = ForwardModel(design, MESH).mesh
    for name in ("JAC", "GREIT", "BP"):
        other = PyeitPictures(design, protocol, grid, mesh, name)
        for regularisation in LAMBDAS if name != "BP" else (0.0,):
            yield (f"pyEIT {name}", f"{regularisation:g}"), partial(other.pictures, regularisation)


def _own_pictures(
    first: Reconstructor, rule: Regularisation, values: Array, references: Array
) -> Array:
    """Pictures of this package; `first` is of another rule, and shares what it has computed."""
    first.choose_lambda()
    maker = copy(first)
    maker.regularisation = rule
    return maker.images(maker.data(values, references))


class PyeitPictures:
    """Pictures by pyEIT 1.2.4 (Liu et al. 2018).

    Electrodes are the points of the mesh that are nearest to their middles. Differences are divided
    by the factor that takes pyEIT's values to the reference.
    """

    def __init__(
        self, design: SensorDesign, protocol: Protocol, grid: PixelGrid, mesh: Mesh, name: str
    ) -> None:
        """Take the lowest triangles of a mesh of prisms; the solver waits for the first picture."""
        lowest = mesh.cells[(mesh.points[mesh.cells[:, :3], 2] == 0.0).all(axis=1), :3]
        used, numbers = np.unique(lowest, return_inverse=True)
        self._nodes, self._cells = mesh.points[used, :2], numbers.reshape(-1, 3)
        self._design, self._protocol, self._grid, self._name = design, protocol, grid, name

    @cached_property
    def _solver(self) -> Any:
        """Solver of all channels."""
        name = self._name
        kind = getattr(require(f"pyeit.eit.{name.lower()}", "bench"), name)
        wrapper, protocols = require("pyeit.mesh", "bench"), require("pyeit.eit.protocol", "bench")
        table = np.array(self._protocol.table)
        per_drive = int((table[:, :2] != table[0, :2]).any(axis=1).argmax())
        pairs = protocols.PyEITProtocol(
            table[::per_drive, :2],
            table[:, 2:].reshape(-1, per_drive, 2),
            np.ones(len(table), dtype=bool),
        )
        centres = np.array([(each.x, each.y) for each in self._design.electrodes])
        _, electrodes = cKDTree(self._nodes).query(centres)
        solver = kind(
            wrapper.PyEITMesh(node=self._nodes, element=self._cells, el_pos=electrodes), pairs
        )
        solver.setup(**({} if name == "BP" else {"p": POWER}))
        return solver

    def pictures(self, regularisation: float, values: Array, references: Array) -> Array:
        """Pictures of frames; lost channels and those of driven electrodes are left out."""
        solver, grid = self._solver, self._grid
        places = self._nodes if self._name == "BP" else self._nodes[self._cells].mean(axis=1)
        if self._name == "GREIT":
            places = np.stack([solver.xg.ravel(), solver.yg.ravel()], axis=1)
        _, nearest = cKDTree(places).query(grid.centres)
        lost = np.isnan(values) | np.isnan(references) | np.array(self._protocol.shares)
        pictures = np.empty((len(values), *grid.shape))
        for missing in np.unique(lost, axis=0):
            solver.H = self._matrix(regularisation, ~missing)
            for k in np.flatnonzero((lost == missing).all(axis=1)):
                now, before = values[k, ~missing], references[k, ~missing]
                if self._name != "BP":
                    model = np.real(solver.v0[~missing])
                    scale = (model @ model) / (before @ model)
                    now, before = scale * now, scale * before
                change = solver.solve(now, before, normalize=self._name == "BP")
                pictures[k] = grid.image(np.real(np.ravel(change))[nearest])
        return pictures

    def _matrix(self, regularisation: float, used: NDArray[np.bool_]) -> Array:
        """Reconstruction matrix of channels, as pyEIT's solver computes it."""
        solver = self._solver
        if self._name == "BP":
            own: Array = solver.B[used].T
            return own
        J = np.real(solver.J[used])
        typical = float(np.sum(J**2)) / len(J if self._name == "GREIT" else J.T)
        lamb = regularisation * typical ** (1.0 - POWER)
        if self._name == "JAC":
            return np.asarray(solver._compute_h(J, POWER, lamb))
        solver.params["lamb"] = lamb
        return np.asarray(solver._compute_h(J, solver._compute_grid_weights(solver.xg, solver.yg)))


def draw_targets(
    path: Path, targets: Sequence[Target], columns: Mapping[str, Array], grid: PixelGrid
) -> None:
    """Draw truths and pictures with the rims of their regions, a row for each target."""
    figure = require("matplotlib.figure", "bench").Figure(
        figsize=(2.1 * (len(columns) + 1), 2.1 * len(targets)), layout="constrained"
    )
    axes = figure.subplots(len(targets), len(columns) + 1, squeeze=False)
    for row, target in enumerate(targets):
        panels = {"truth": target.truth, **{name: each[row] for name, each in columns.items()}}
        for place, (name, values) in zip(axes[row], panels.items(), strict=True):
            limit = float(np.nanmax(np.abs(values)))
            place.imshow(values, origin="lower", cmap="RdBu_r", vmin=-limit, vmax=limit)
            title = target.group
            if name != "truth":
                regions = segment(values, grid)
                place.contour(regions, (-0.5, 0.5), colors="k", linewidths=0.8)
                title = f"{name} {score(target.truth, regions):.2f}"
            place.set_title(title, fontsize=8)
            place.set_axis_off()
    figure.savefig(path, dpi=90, facecolor="white", format="png")
