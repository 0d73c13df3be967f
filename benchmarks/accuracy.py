"""Error against run time of the forward model and of pyEIT: `eitskin bench accuracy`.

Two errors on the reference sensor: of the 28 flat resistances, and of their change under smooth
touch-sized drops of conductivity, the signal; each against a reference far finer, whose own error
is known. Times are per frame of 28 after meshing, of one core. Besides, by the named resolutions,
errors of the signals of bent and pressed sensors, and of resistances between other electrodes than
those of full height, against cosine modes.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks import forward_models as models
from eitskin.benchmarks.cosine_box import box_impedance
from eitskin.benchmarks.forward_models import ModelCase, Truth, judge, model_frame
from eitskin.benchmarks.results import (
    Columns,
    Report,
    ReportTable,
    Watch,
    make_results,
    plot_errors,
)
from eitskin.geometry.deformation.fixtures import Bend, Hinge
from eitskin.geometry.design.electrode import Electrode
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.regular_layouts import grid, uniform
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh_design import CellKind
from eitskin.protocol import Protocol
from eitskin.simulator.electrical.forward_model import ForwardModel
from eitskin.simulator.electrical.resolution import Discretisation, Resolution, discretisation
from eitskin.simulator.scene.indenters import Cylinder, Sphere
from eitskin.simulator.scene.scene import Scene, Touch
from eitskin.simulator.simulator import Simulator
from eitskin.threads import one_thread

Array = NDArray[np.float64]

# The first is the truth, the second says how far it can be trusted.
References: TypeAlias = tuple[Discretisation, Discretisation]
DEFORMED_REFERENCES: References = (
    ((5, 5, 5, 5, 4, 3), Grading(4e-5, 5e-3, 3.0)),
    ((6, 6, 5, 4, 3), Grading(4e-5, 6e-3, 2.5)),
)
QUICK_DEFORMED_REFERENCES: References = (
    ((4, 4, 3, 2, 1), Grading(1e-4, 6e-3, 3.0)),
    ((4, 4, 3, 2, 1), Grading(2e-4, 6e-3, 3.0)),
)

# Smooth at the ends of the bend: F may jump at element faces only.
FIXTURE = Hinge(transition=0.010)


PRESSES: Mapping[str, Scene] = {
    "10 N": Scene(touches=(Touch(0.060, 0.030),)),
    "10 N in the middle": Scene(touches=(Touch(0.075, 0.030),)),
    "10 N at (45, 15)": Scene(touches=(Touch(0.045, 0.015),)),
    "10 N at (75, 15)": Scene(touches=(Touch(0.075, 0.015),)),
    "10 N by an electrode": Scene(touches=(Touch(0.075, 0.0075),)),
    "2 N, ball": Scene(touches=(Touch(0.060, 0.030, 2.0, Sphere(0.003)),)),
    "2 N, ball at (45, 15)": Scene(touches=(Touch(0.045, 0.015, 2.0, Sphere(0.003)),)),
    "10 N, 20 mm cylinder": Scene(touches=(Touch(0.045, 0.015, 10.0, Cylinder(0.010)),)),
    "10 N, bend 30": Scene(Bend(30.0), (Touch(0.110, 0.035),)),
    "10 N in the bend": Scene(Bend(30.0), (Touch(0.075, 0.030),)),
}
BENDS = {f"bend {angle:g}": Scene(Bend(angle)) for angle in (50.0, -20.0)}
SCENES: Mapping[str, Scene] = {**BENDS, **PRESSES}
QUICK_SCENES = ("bend 50", "10 N")
QUICK_ELECTRODES = ("full height", "on top")


@dataclass(frozen=True, slots=True)
class DeformedCase:
    """Signal errors of one resolution.

    Attributes:
        name: name of the resolution.
        frame_seconds: median per frame, deformation evaluated, assembled and solved again.
        signal_errors: signal errors per scene, norm of the error of the relative change over norm
            of the change, of the bend or, in scenes that are pressed, of the press.
    """

    name: str
    frame_seconds: float
    signal_errors: dict[str, float]


def signals(sim: Simulator, scenes: Mapping[str, Scene]) -> tuple[dict[str, Array], list[float]]:
    """Relative change of each measurement that each scene makes, and the time of each [s]."""
    changes, times = {}, []

    @cache
    def resistances(scene: Scene) -> Array:
        start = time.process_time()
        frame = sim.measure(scene)
        times.append(time.process_time() - start)
        return frame.impedance.real

    for name, scene in scenes.items():
        before = Scene(bend=scene.bend) if scene.touches else Scene()
        changes[name] = resistances(scene) / resistances(before) - 1.0
    return changes, times


def compare_deformed(quick: bool) -> list[DeformedCase]:
    """Errors of resolutions, and of the second reference, against the first reference.

    On the reference sensor, bent by a hinge with transitions.
    """
    design = SensorDesign.reference()
    scenes = {name: SCENES[name] for name in (QUICK_SCENES if quick else SCENES)}
    first, second = QUICK_DEFORMED_REFERENCES if quick else DEFORMED_REFERENCES
    named: dict[str, Resolution | Discretisation] = {"second reference": second, "fast": "fast"}
    if not quick:
        named |= {"standard": "standard", "fine": "fine"}
    truth, _ = signals(Simulator(design, first, FIXTURE), scenes)
    rows = []
    for name, resolution in named.items():
        sim = Simulator(design, resolution, FIXTURE)
        found, times = signals(sim, scenes)
        errors = {
            scene: float(np.linalg.norm(found[scene] - truth[scene]) / np.linalg.norm(truth[scene]))
            for scene in scenes
        }
        rows.append(DeformedCase(name, float(np.median(times)), errors))
    return rows


def electrode_designs() -> dict[str, tuple[SensorDesign, CellKind]]:
    """Small sensors with electrodes on the side, on top, at the bottom and inside, and cells."""
    sheet, size = Rectangle(0.060, 0.030), 0.006
    side, inside = uniform(sheet, 4), grid(sheet, 1, 2, size, on="inside", z=0.002)
    low = tuple(replace(each, height=1e-3 * (1 + k)) for k, each in enumerate(side))
    pads = [grid(sheet, 1, 2, size, on=face) for face in ("top", "bottom")]
    kinds: dict[str, tuple[tuple[Electrode, ...], CellKind]] = {
        "full height": (side, "hexahedra"),
        "1 to 4 mm high": (low, "hexahedra"),
        "1 to 4 mm high, prisms": (low, "prisms"),
        "on top": (grid(sheet, 2, 2, size), "hexahedra"),
        "on top and at the bottom": (pads[0] + pads[1], "hexahedra"),
        "on the side and on top": (side + pads[0], "hexahedra"),
        "on the side and inside": (side + inside, "hexahedra"),
    }
    return {
        name: (SensorDesign(sheet, 0.005, some), cells) for name, (some, cells) in kinds.items()
    }


@dataclass(frozen=True, slots=True)
class ElectrodeCase:
    """Largest relative errors of resistances between electrodes of one kind.

    Attributes:
        name: kind of electrodes.
        reference_error: difference of cosine modes with fewer polynomials.
        errors: errors by resolution.
        unknowns: unknowns by resolution.
    """

    name: str
    reference_error: float
    errors: dict[Resolution, float]
    unknowns: dict[Resolution, int]


def compare_electrodes(name: str, quick: bool) -> ElectrodeCase:
    """Errors of one of `electrode_designs` by resolutions, against cosine modes of the box."""
    design, cells = electrode_designs()[name]
    measure = Protocol.pairwise(len(design.electrodes)).measure
    exact, fewer = (measure(box_impedance(design, count)).real for count in (9, 7))
    errors, unknowns = {}, {}
    names: tuple[Resolution, ...] = ("fast",) if quick else ("fast", "standard")
    for resolution in names:
        model = ForwardModel(design, resolution, cells=cells)
        found = measure(model.impedance()).real
        errors[resolution] = float(np.abs(found / exact - 1.0).max())
        unknowns[resolution] = model.unknowns
    return ElectrodeCase(name, float(np.abs(fewer / exact - 1.0).max()), errors, unknowns)


@dataclass(frozen=True, slots=True)
class ModelResult:
    """One point of the plot.

    Attributes:
        family, name: the line of the plot, and the point on it.
        nodes, unknowns: sizes of the mesh and of the matrix.
        frame_seconds: seconds per frame of 28, all but the mesh repeated.
        resistance_error, signal_error: errors as in `judge`.
    """

    family: str
    name: str
    nodes: int
    unknowns: int
    frame_seconds: float
    resistance_error: float
    signal_error: float


def measure(case: ModelCase, truth: Truth) -> ModelResult:
    """Errors and times of one forward model."""
    model = case.model(truth.design)
    judged, nodes = judge(model_frame(model), truth), len(model.mesh.points)
    return ModelResult(case.family, case.name, nodes, model.unknowns, **judged)


def compare(case: ModelCase, truth: Truth) -> tuple[ModelResult, ModelResult]:
    """Results of eitskin and of pyEIT on the mesh of one case, plane where it has one order."""
    order, _ = discretisation(case.resolution, truth.design, case.cells)
    plane = len(order) == 1
    mesh = ForwardModel(truth.design, case.resolution).mesh
    model = models.PointElectrodeModel(truth.design, mesh, plane)
    family = "pyEIT, triangles" if plane else "pyEIT, tetrahedra"
    background = float(np.real(truth.design.evaluate_conductivity(np.zeros(3))))
    judged = judge(model.frame(background), truth)
    other = ModelResult(family, case.name, model.nodes, model.nodes, **judged)
    own = measure(case, truth)
    return replace(own, nodes=model.nodes), other


def run(seed: int, quick: bool, watch: Watch = lambda _, items: items) -> Report:
    """Measure everything on one core.

    Args:
        seed: seed of the places of the conductivity drops.
        quick: fewer models and a coarser reference, in seconds instead of minutes.
        watch: gives back the items that its text is about; shows progress where wanted.
    """
    began = time.perf_counter()
    peers = (models.QUICK_PEERS if quick else models.PEERS) if models.has_pyeit() else ()
    references = models.QUICK_REFERENCES if quick else models.REFERENCES
    with one_thread():
        (truth,) = (Truth.compute(seed, pair) for pair in watch("reference", [references]))
        cases = models.QUICK if quick else models.FULL
        results = [measure(case, truth) for case in watch("models", cases)]
        duels = [compare(case, truth) for case in watch("pyEIT", peers)]
        (deformed,) = (compare_deformed(each) for each in watch("bent and pressed", [quick]))
        kinds = QUICK_ELECTRODES if quick else tuple(electrode_designs())
        electrodes = [compare_electrodes(kind, quick) for kind in watch("electrodes", kinds)]
    points = [*results, *(own for own, _ in duels), *(other for _, other in duels)]
    by_family: dict[str, list[ModelResult]] = {}
    for point in points:
        by_family.setdefault(point.family, []).append(point)
    sentences = [
        f"two references differ by {truth.resistance_error:.1e} in R and "
        f"{truth.signal_error:.1e} in the signal",
        *(
            f"{other.family}, {other.nodes} nodes: ours on the same nodes is "
            f"{other.frame_seconds / own.frame_seconds:.0f} times faster"
            for own, other in duels
        ),
    ]
    if not duels:
        sentences.append("pyEIT is not installed and was left out: pip install 'eitskin[bench]'")
    scenes = [
        (scene, *(f"{row.signal_errors[scene]:.1e}" for row in deformed))
        for scene in deformed[0].signal_errors
    ]
    figures = {
        "references.resistance_error": truth.resistance_error,
        "references.signal_error": truth.signal_error,
    }
    figures |= _figures([(f"{point.family}, {point.name}", point) for point in results])
    for own, other in duels:
        peer = f"{other.family}, {other.name}"
        figures |= _figures([(peer, other), (f"ours on the nodes of {peer}", own)])
        figures[f"{peer}.times_longer"] = other.frame_seconds / own.frame_seconds
    for row in deformed:
        name, errors = f"bent and pressed, {row.name}", row.signal_errors
        figures |= {f"{name}.{scene}": error for scene, error in errors.items()}
        figures[f"{name}.frame_ms"] = 1e3 * row.frame_seconds
        figures[f"{name}.largest of presses"] = max(errors[s] for s in errors if s in PRESSES)
    for each in electrodes:
        figures[f"electrodes {each.name}.reference_error"] = each.reference_error
        for resolution, error in each.errors.items():
            figures[f"electrodes {each.name}, {resolution}.resistance_error"] = error
            figures[f"electrodes {each.name}, {resolution}.unknowns"] = each.unknowns[resolution]
    panels = {
        title: {
            family: [(1e3 * p.frame_seconds, getattr(p, quantity)) for p in some]
            for family, some in by_family.items()
        }
        for quantity, title in _PANELS.items()
    }
    x, y, rows = "time per frame of 28 [ms]", "error", [asdict(point) for point in points]
    return Report(
        results=make_results("accuracy", figures.items(), began=began, seed=seed, quick=quick),
        rows=rows,
        tables=[
            ReportTable.from_rows(rows, _COLUMNS, 2),
            ReportTable(("signal errors", *(row.name for row in deformed)), scenes),
            ReportTable(
                ("electrodes", "cosine modes, fewer", *electrodes[0].errors),
                [
                    (
                        row.name,
                        *(f"{value:.1e}" for value in (row.reference_error, *row.errors.values())),
                    )
                    for row in electrodes
                ],
            ),
        ],
        sentences=sentences,
        plots={"accuracy.png": partial(plot_errors, panels=panels, x=x, y=y)},
    )


_COLUMNS: Columns = {
    "mesh and element": ("family", "", 1),
    "": ("name", "", 1),
    "unknowns": ("unknowns", "d", 1),
    "ms/frame": ("frame_seconds", ".1f", 1e3),
    "error of R": ("resistance_error", ".1e", 1),
    "of signal": ("signal_error", ".1e", 1),
}
_QUANTITIES = ("nodes", "unknowns", "resistance_error", "signal_error")
_PANELS = {
    "resistance_error": "28 flat resistances: largest relative error",
    "signal_error": "change under a 30 % drop of conductivity: relative error",
}


def _figures(points: Sequence[tuple[str, ModelResult]]) -> dict[str, float]:
    """Figures of results by their labels."""
    figures = {f"{label}.frame_ms": 1e3 * point.frame_seconds for label, point in points}
    for name in _QUANTITIES:
        figures |= {f"{label}.{name}": getattr(point, name) for label, point in points}
    return figures
