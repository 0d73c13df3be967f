"""Cramer-Rao bounds of a press all over the sheet, by electrode layout: `eitskin bench layouts`.

Derivatives by place and force are central differences of solved scenes (`Simulator.measure_all`): a
press of 10 N changes the conductivity beneath it by so much that the first order of the adjoint
sensitivity misses the signal altogether. The derivative by the angle is that of the sheet without
the press. docs/results/simulator.md gives bounds.
"""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.results import Columns, Progress, Report, ReportTable, make_results
from eitskin.datasets.store.worker_processes import run_tasks
from eitskin.extras import require
from eitskin.geometry import Bend, ConfigurationError, Electrode, Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import grid, uniform
from eitskin.hardware.protocol.packets import PER_PACKET
from eitskin.simulator import Instrument, Protocol, Scene, Simulator, Touch
from eitskin.simulator.electrical.resolution import discretisation
from eitskin.simulator.instrument.ad5940 import MEASUREMENT_TIME
from eitskin.training.evaluation.cramer_rao import (
    FORCE_STEP,
    PLACE_STEP,
    SceneDerivatives,
    scene_derivatives,
)
from eitskin.training.evaluation.drawing import draw_sensor, new_figure
from eitskin.training.method.input_spec import mirrors

Array = NDArray[np.float64]

FORCE = 10.0  # of the press [N]
_PAD_ORDERS = (2, 2, 2)  # from a pad currents spread in height as they do in the plane
_STENCIL = ((-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1))

COUNTS = (6, 8, 10, 12, 16, 32)
WIDTHS = (0.002, 0.0035, 0.005, 0.008, 0.012)  # along the rim [m]
CONTACTS = (1e-5, 1e-4, 1e-3, 1e-2)  # [ohm m2]
BENT_COUNTS = (8, 12, 16, 32)  # of electrodes on the rim of bent sheets
ANGLES = (-20.0, -10.0, 0.0, 10.0, 20.0, 30.0, 40.0, 50.0)  # [deg]
_OUTLINE = Rectangle(0.150, 0.060)  # of the paper's sensor [m]
_RIM = 0.005  # from the rim to the middle of a pad next to it [m]


@dataclass(frozen=True, slots=True)
class Layout:
    """Electrode layout of a bent sensor, of which every pair is measured.

    Attributes:
        name: name of the layout, for tables; says nothing about it.
        design: the sensor.
        angle_deg: angle of the bend at which it is tested [deg].
    """

    name: str
    design: SensorDesign
    angle_deg: float = 0.0

    @property
    def protocol(self) -> Protocol:
        """Protocol that measures all pairs."""
        return Protocol.pairwise(len(self.design.electrodes))

    @property
    def scan_time(self) -> float:
        """Time from one frame to the next [s]."""
        return len(self.protocol) * MEASUREMENT_TIME


def paper() -> Layout:
    """Layout of the paper's sensor."""
    return Layout("paper: 8 on the rim", SensorDesign.reference())


def with_electrodes(name: str, electrodes: Sequence[Electrode]) -> Layout:
    """Layout of the paper's sensor with other electrodes.

    Raises ConfigurationError, naming the layout, for electrodes that overlap or do not fit.
    """
    try:
        design = replace(SensorDesign.reference(), electrodes=tuple(electrodes))
    except ConfigurationError as error:
        raise ConfigurationError(f"layout '{name}': {error}") from error
    return Layout(name, design)


def sweeps() -> dict[str, tuple[Layout, ...]]:
    """Layouts by the name of their sweep; the paper's layout is in each."""
    return {
        "count": tuple(_on_rim(f"{count} on the rim", count) for count in COUNTS),
        "placement": tuple(_placements()),
        "width": tuple(_on_rim(f"{1e3 * width:g} mm wide", width=width) for width in WIDTHS),
        "contact": tuple(_on_rim(f"{z:g} ohm m2", contact_impedance=z) for z in CONTACTS),
        "bend": tuple(
            replace(_on_rim(f"{count}, {angle:g} deg", count), angle_deg=angle)
            for count in BENT_COUNTS
            for angle in ANGLES
        ),
    }


def _on_rim(
    name: str, count: int = 8, width: float = 0.005, contact_impedance: float = 1e-3
) -> Layout:
    """Electrodes evenly spaced on the rim, one in the middle of the lower side as in the paper."""
    start = _OUTLINE.length / 2 % (_OUTLINE.perimeter / count)
    return with_electrodes(name, uniform(_OUTLINE, count, width, start, contact_impedance))


def _placements() -> Iterator[Layout]:
    """Layouts of eight 5 mm electrodes: on the rim, on top next to it, on top all over, inside."""
    design = paper().design
    half = design.thickness / 2
    yield paper()
    rim = np.array([(e.x, e.y) for e in design.electrodes])
    kinds: tuple[tuple[Literal["top", "inside"], float | None, str], ...] = (
        ("top", None, "on top"),
        ("inside", half, "inside"),
    )
    for on, z, where in kinds:
        beside = np.clip(rim, _RIM, np.array([_OUTLINE.length, _OUTLINE.width]) - _RIM)
        pads = [Electrode(x, y, z=z, on=on) for x, y in beside.tolist()]
        yield with_electrodes(f"{where}, beside the rim", pads)
        spread = grid(_OUTLINE, 2, 4, 0.005, on=on, z=z)
        yield with_electrodes(f"{where}, 2 x 4", spread)


@dataclass(frozen=True, slots=True)
class Sampling:
    """Grid of positions that a layout is tested at.

    Attributes:
        spacing: spacing of the places, at most [m].
        margin: margin without places [m]: presses nearer to the rim are detected by images only.
    """

    spacing: float = 0.0075
    margin: float = 0.0075

    def grid(self, design: SensorDesign) -> tuple[Array, Array]:
        """Coordinates x and y of the grid [m], symmetric about the middle of the sheet."""
        return self._line(design.outline.length), self._line(design.outline.width)

    def _line(self, extent: float) -> Array:
        room = extent - 2.0 * self.margin
        if not (self.spacing > 0.0 and room > 0.0):
            raise ConfigurationError(
                f"places {self.spacing:g} m apart and {self.margin:g} m from the rim do not fit on "
                f"{extent:g} m"
            )
        return self.margin + np.linspace(0.0, room, math.ceil(room / self.spacing - 1e-9) + 1)


@dataclass(frozen=True, slots=True, eq=False)
class SheetBound:
    """Bounds of one press of 10 N on a sheet, from one frame against a reference of one frame.

    Attributes:
        x, y: lines of the places (nx,), (ny,) [m].
        place: sqrt(var x + var y) with the angle of the bend unknown (ny, nx) [m].
        force: angle unknown (ny, nx) [N].
        angle_deg: angle of the bend, next to the press (ny, nx) [deg].
        untouched_deg: bound of the angle of the untouched sheet [deg].
    """

    x: Array
    y: Array
    place: Array
    force: Array
    angle_deg: Array
    untouched_deg: float


def sheet_bound(layout: Layout, sampling: Sampling) -> SheetBound:
    """Bounds over the sheet, solved in the part that the mirrors of the layout do not repeat.

    Raises ConfigurationError, naming the layout, where its measurements do not determine a press.
    """
    orders, grading = discretisation("fast", layout.design, "hexahedra")
    if any(electrode.on != "side" for electrode in layout.design.electrodes):
        orders = _PAD_ORDERS
    sim = Simulator(layout.design, (orders, grading))
    x, y = sampling.grid(layout.design)
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    numbers, turned = np.arange(len(places)).reshape(len(y), len(x)), slice(None, None, -1)
    images = [
        numbers[turned if flip_y else slice(None), turned if flip_x else slice(None)].ravel()
        for flip_x, flip_y in (each.flips for each in mirrors(layout.design, layout.protocol))
    ]
    first = np.min(images, axis=0)
    solved = np.unique(first)
    instrument, full_scale = Instrument(), sim.full_scale
    untouched = scene_derivatives(sim, Scene(Bend(layout.angle_deg)))
    try:
        alone = untouched.bound(untouched.noise(instrument, full_scale))
        rows = []
        for found in touch_derivatives(sim, untouched, layout.angle_deg, places[solved]):
            least = found.bound(found.noise(instrument, full_scale))
            rows.append((least.place[0], least.force[0], least.angle_deg))
    except ConfigurationError as error:
        raise ConfigurationError(f"layout '{layout.name}': {error}") from error
    maps = np.array(rows)[np.searchsorted(solved, first)].T.reshape(-1, len(y), len(x))
    place, force, angle = maps
    return SheetBound(x, y, place, force, angle, alone.angle_deg)


def touch_derivatives(
    sim: Simulator, untouched: SceneDerivatives, angle_deg: float, places: Array
) -> list[SceneDerivatives]:
    """Derivatives at a press of 10 N at each position (n, 2) [m], and by the untouched angle."""
    step = np.array([PLACE_STEP, PLACE_STEP, FORCE_STEP * FORCE])
    moved = np.array([(x, y, FORCE) for x, y in places])[:, None] + np.array(_STENCIL) * step
    scenes = [
        Scene(Bend(angle_deg), (Touch(x, y, force),))
        for x, y, force in moved.reshape(-1, 3).tolist()
    ]
    resistance = sim.measure_all(scenes).real.reshape(len(places), 3, 2, -1)
    logarithms = np.log(np.abs(resistance))
    slopes = (logarithms[:, :, 1] - logarithms[:, :, 0]) / (2.0 * step[:, None])
    pressed = resistance[:, 2].mean(axis=1)
    return [
        SceneDerivatives(level, slope[None], untouched.by_angle)
        for level, slope in zip(pressed, slopes, strict=True)
    ]


NAMES = tuple(sweeps())
SAMPLING, QUICK_SAMPLING = Sampling(), Sampling(0.0225)
_COLUMNS: Columns = {
    "": ("layout", "", 1),
    "n": ("n", "", 1),
    "scan [ms]": ("scan_ms", ".0f", 1),
    "50 % [mm]": ("place_mm", ".2f", 1),
    "90 %": ("place_90_mm", ".2f", 1),
    "worst": ("place_worst_mm", ".2f", 1),
    "paced": ("place_90_paced_mm", ".2f", 1),
    "force [N]": ("force_90_n", ".2f", 1),
    "angle [deg]": ("angle_untouched_deg", ".3f", 1),
}
LEGEND = (
    "bound of the place of 10 N: median, 90 % and worst over the sheet, and 90 % paced, for as "
    "many frames as take the time of the paper's; force: 90 %; angle: of the untouched sheet; "
    "* a frame that does not fit into one packet on the wire"
)
_MOST, _ABREAST = 6, 2  # maps

Judged = tuple[str, Layout, SheetBound]
"""Sweep, layout and its bounds."""


def table_row(sweep: str, layout: Layout, bound: SheetBound) -> dict[str, Any]:
    """Row of table.csv of one layout.

    Percentiles are over the sheet; bounds are of one frame against a reference of one, with the
    angle of the bend unknown. `paced` is the bound for the mean of as many frames as take the time
    of one of the paper's layout, or their fraction; `fits_wire` says whether a frame fits into one
    packet, `electrodes_mm` "x y" of each middle.
    """
    place, place_90, place_worst = np.percentile(1e3 * bound.place, (50, 90, 100)).tolist()
    electrodes = layout.design.electrodes
    return {
        "sweep": sweep,
        "layout": layout.name,
        "angle_deg": layout.angle_deg,
        "measurements": len(layout.protocol),
        "scan_ms": 1e3 * layout.scan_time,
        "fits_wire": len(layout.protocol) <= PER_PACKET,
        "place_mm": place,
        "place_90_mm": place_90,
        "place_worst_mm": place_worst,
        "place_90_paced_mm": place_90 * (layout.scan_time / paper().scan_time) ** 0.5,
        "force_90_n": float(np.percentile(bound.force, 90)),
        "angle_90_deg": float(np.percentile(bound.angle_deg, 90)),
        "angle_untouched_deg": bound.untouched_deg,
        "electrodes_mm": "; ".join(f"{1e3 * e.x:g} {1e3 * e.y:g}" for e in electrodes),
    }


def run(
    names: Sequence[str] = NAMES,
    quick: bool = False,
    workers: int = 1,
    progress: Progress = lambda *_: None,
) -> Report:
    """Test the layouts of the named sweeps; a quick run has few places.

    Raises ConfigurationError for an unknown sweep, PartialError where a worker died.
    """
    if unknown := sorted(set(names) - set(NAMES)):
        raise ConfigurationError(
            f"expected sweeps out of {', '.join(NAMES)}, got {', '.join(unknown)}"
        )
    began = time.perf_counter()
    asked = [(name, each) for name, some in sweeps().items() if name in names for each in some]
    distinct = list({(each.design, each.angle_deg): each for _, each in asked}.values())
    solve, bounds = partial(sheet_bound, sampling=QUICK_SAMPLING if quick else SAMPLING), {}
    for number, (each, bound) in enumerate(run_tasks(solve, distinct, workers), 1):
        bounds[each.design, each.angle_deg] = bound
        progress("layouts", number, len(distinct))
    judged = [(name, each, bounds[each.design, each.angle_deg]) for name, each in asked]
    rows = [table_row(*each) for each in judged]
    by_title: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        mark = "" if row["fits_wire"] else "*"
        by_title.setdefault(row["sweep"], []).append(row | {"n": f"{row['measurements']}{mark}"})
    tables = [
        replace(ReportTable.from_rows(some, _COLUMNS), headings=(title, *list(_COLUMNS)[1:]))
        for title, some in by_title.items()
    ]
    figures = [pair for table in tables for pair in table.figures(table.headings[0])]
    return Report(
        results=make_results("layouts", figures, began=began, quick=quick, options="--workers 2"),
        rows=rows,
        tables=tables,
        sentences=[LEGEND],
        plots={"layouts.png": partial(plot_maps, judged)},
    )


def plot_maps(judged: Sequence[Judged], path: Path) -> None:
    """Draw the bound of the place [mm] of up to six flat layouts on one logarithmic scale."""
    flat = {each[1].design: each for each in judged if not each[1].angle_deg}
    shown = list(flat.values())[:_MOST]
    values = np.concatenate([1e3 * bound.place.ravel() for *_, bound in shown])
    ends = np.percentile(values, (2, 100))
    scale = require("matplotlib.colors", "bench").LogNorm(*ends.tolist())
    rows = -(-len(shown) // _ABREAST)
    figure = new_figure(9.5, 2.05 * rows + 0.4)
    axes_grid = figure.subplots(rows, _ABREAST, squeeze=False, sharex=True, sharey=True)
    for axes, (_, layout, bound) in zip(axes_grid.ravel(), shown, strict=False):
        values = 1e3 * bound.place
        filled = axes.pcolormesh(
            1e3 * bound.x, 1e3 * bound.y, values, norm=scale, shading="nearest"
        )
        draw_sensor(axes, layout.design)
        title = f"{layout.name}: 90 % below {np.percentile(values, 90):.2f} mm"
        axes.set_title(title, fontsize=9)
        axes.set(xlabel="x [mm]", ylabel="y [mm]")
        axes.label_outer()
    for axes in axes_grid.ravel()[len(shown) :]:
        axes.set_visible(False)
    label = "bound of the place of 10 N [mm]"
    figure.colorbar(filled, ax=axes_grid, label=label, shrink=0.8, extend="min", format="%g")
    figure.savefig(path, dpi=120, facecolor="white", format="png")
