"""Comparison of layouts: sweeps, searches, and the figures of each layout."""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from eitskin.benchmarks.layouts import free as layouts_free
from eitskin.benchmarks.layouts.bound import Sampling, SheetBound
from eitskin.benchmarks.layouts.candidates import (
    SIZE,
    Layout,
    paper,
    sweeps,
    with_electrodes,
)
from eitskin.benchmarks.layouts.free import FreePlan, free_search
from eitskin.benchmarks.layouts.ring import solved_ring
from eitskin.benchmarks.layouts.search import (
    COUNT,
    QUICK,
    Candidate,
    SearchPlan,
    at_arcs,
    possible,
    search,
)
from eitskin.benchmarks.layouts.store import Judge, Watch, judging
from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.hardware.protocol.frame_parts import PER_PACKET
from eitskin.provenance import Provenance

SEED = 0  # of the search without symmetry, and of pipelines; nothing else is random
SEARCH, FREE = "search", "free"  # sweeps
MIRRORED, TURNED, FREED = "best with both mirrors", "best with a half turn", "best of all"
NAMES = (*sweeps(), SEARCH, FREE)
SAMPLING, FINE = Sampling(0.0075), Sampling(0.0075, resolution="standard")
QUICK_SAMPLING = Sampling(0.0225)
FREE_WIDTHS = (0.002, 0.008)  # of the electrodes of the best layouts, beside 5 mm [m]


@dataclass(frozen=True, slots=True)
class JudgedLayout:
    """Layout and its bounds."""

    sweep: str
    layout: Layout
    sampling: Sampling
    bound: SheetBound


@dataclass(frozen=True, slots=True)
class LayoutFigures:
    """Figures of one layout in the tables.

    Percentiles are over the sheet; bounds are of one frame against a reference of one, with the
    angle of the bend unknown where nothing else is said.

    Attributes:
        sweep: that the layout belongs to.
        layout: its name.
        resolution, spacing_mm: of its judgement.
        angle_deg: of the bend.
        measurements: in a frame.
        scan_ms: from one frame to the next [ms].
        fits_wire: whether a frame fits into one packet.
        place_mm, place_90_mm, place_worst_mm: median, 90th percentile and worst place [mm].
        place_90_known_mm: 90th percentile with the angle known [mm].
        place_90_paced_mm: 90th percentile for the mean of as many frames as take the time of one
            of the paper's layout, or their fraction [mm].
        force_n, force_90_n, force_worst_n: the same of the force [N].
        angle_90_deg: 90th percentile of the angle's bound beside a press [deg].
        angle_untouched_deg: bound of the angle of the untouched sheet [deg].
        uniformity: 10th over 90th percentile of the signal.
        condition: largest over 15th singular value of the signals.
        patterns: independent patterns of the signals above the noise.
        full_scale_ohm: largest resistance [ohm]; the noise is relative to it.
        electrodes_mm: "x y" of each middle, with semicolons between [mm].
    """

    sweep: str
    layout: str
    resolution: str
    spacing_mm: float
    angle_deg: float
    measurements: int
    scan_ms: float
    fits_wire: bool
    place_mm: float
    place_90_mm: float
    place_worst_mm: float
    place_90_known_mm: float
    place_90_paced_mm: float
    force_n: float
    force_90_n: float
    force_worst_n: float
    angle_90_deg: float
    angle_untouched_deg: float
    uniformity: float
    condition: float
    patterns: int
    full_scale_ohm: float
    electrodes_mm: str

    @classmethod
    def of(cls, judged: JudgedLayout) -> "LayoutFigures":
        """Figures of a judged layout."""
        layout, sampling, bound = judged.layout, judged.sampling, judged.bound
        place, place_90, worst = _percentiles(1e3 * bound.place)
        force, force_90, force_worst = _percentiles(bound.force)
        return cls(
            sweep=judged.sweep,
            layout=layout.name,
            resolution=sampling.resolution,
            spacing_mm=1e3 * sampling.spacing,
            angle_deg=layout.angle_deg,
            measurements=len(layout.protocol),
            scan_ms=round(1e3 * layout.scan_time, 1),
            fits_wire=len(layout.protocol) <= PER_PACKET,
            place_mm=place,
            place_90_mm=place_90,
            place_worst_mm=worst,
            place_90_known_mm=_percentiles(1e3 * bound.place_known)[1],
            place_90_paced_mm=place_90 * (layout.scan_time / paper().scan_time) ** 0.5,
            force_n=force,
            force_90_n=force_90,
            force_worst_n=force_worst,
            angle_90_deg=_percentiles(bound.angle_deg)[1],
            angle_untouched_deg=bound.untouched_deg,
            uniformity=bound.uniformity,
            condition=bound.condition,
            patterns=bound.patterns,
            full_scale_ohm=bound.full_scale,
            electrodes_mm="; ".join(
                f"{1e3 * e.x:g} {1e3 * e.y:g}" for e in layout.design.electrodes
            ),
        )


@dataclass(frozen=True, slots=True)
class LayoutComparison:
    """All judged layouts and their provenance."""

    judged: tuple[JudgedLayout, ...]
    provenance: Provenance
    quick: bool

    @property
    def figures(self) -> list[LayoutFigures]:
        """Figures of each layout, in order."""
        return [LayoutFigures.of(each) for each in self.judged]

    def found(self, sweep: str, resolution: str) -> dict[str, LayoutFigures]:
        """Figures of the layouts that a search ends with, by name; empty where it was not run."""
        return {
            each.layout.name: LayoutFigures.of(each)
            for each in self.judged
            if (each.sweep, each.sampling.resolution) == (sweep, resolution)
        }


def run(
    folder: Path,
    *,
    names: Sequence[str] = NAMES,
    quick: bool = False,
    workers: int = 1,
    watch: Watch = lambda _: None,
) -> LayoutComparison:
    """Judge the layouts of the sweeps, and search, keeping each finished layout in `folder`.

    Args:
        folder: for the files of finished layouts; a run that was stopped goes on from them.
        names: of sweeps; "search" and "free" are two.
        quick: few places, few layouts in the search.
        workers: processes that judge.
        watch: called with the name of each finished layout.

    Raises ConfigurationError for an unknown sweep, PartialError as `judging` does.
    """
    if unknown := sorted(set(names) - set(NAMES)):
        raise ConfigurationError(
            f"expected sweeps out of {', '.join(NAMES)}, got {', '.join(unknown)}"
        )
    sampling = QUICK_SAMPLING if quick else SAMPLING
    with judging(folder, workers, watch) as judge:
        asked = [
            (name, layout)
            for name, layouts in sweeps().items()
            if name in names
            for layout in layouts
        ]
        bounds = judge([(layout, sampling) for _, layout in asked])
        judged = [
            JudgedLayout(name, layout, sampling, bound)
            for (name, layout), bound in zip(asked, bounds, strict=True)
        ]
        if SEARCH in names:
            judged += _searched(judge, quick)
        if FREE in names:
            judged += _freed(judge, folder, quick)
    return LayoutComparison(tuple(judged), Provenance.now(SEED), quick)


def best_found(judge: Judge, folder: Path, quick: bool) -> dict[str, Candidate]:
    """Best layouts with both mirrors and without any symmetry, by name."""
    mirrored, _ = search(judge, QUICK if quick else SearchPlan())
    plan = layouts_free.QUICK if quick else FreePlan(seed=SEED)
    ring = solved_ring(folder, plan.pitch, plan.sampling)
    return {MIRRORED: mirrored, FREED: free_search(judge, ring, plan, [mirrored.arcs])}


def _searched(judge: Judge, quick: bool) -> Iterator[JudgedLayout]:
    """Layouts found and usual layouts, judged as in the search and then on a finer mesh."""
    plan = QUICK if quick else SearchPlan()
    mirrored, turned = search(judge, plan)
    electrodes = uniform(Rectangle(*SIZE), COUNT)
    layouts = [
        paper(),
        with_electrodes("even, half a pitch on", electrodes),
        dataclasses.replace(mirrored.layout, name=MIRRORED),
        dataclasses.replace(turned.layout, name=TURNED),
    ]
    yield from _twice(SEARCH, layouts, plan.sampling, judge, quick)


def _freed(judge: Judge, folder: Path, quick: bool) -> Iterator[JudgedLayout]:
    """Best of all beside the best with mirrors and the paper's, and both in other widths."""
    best = best_found(judge, folder, quick)
    layouts = [paper(), *(at_arcs(name, found.arcs) for name, found in best.items())]
    layouts += [
        at_arcs(f"{name}, {1e3 * width:g} mm wide", found.arcs, width)
        for name, found in best.items()
        for width in (() if quick else FREE_WIDTHS)
        if possible(found.arcs, width)
    ]
    yield from _twice(FREE, layouts, QUICK_SAMPLING if quick else SAMPLING, judge, quick)


def _twice(
    sweep: str, layouts: Sequence[Layout], sampling: Sampling, judge: Judge, quick: bool
) -> Iterator[JudgedLayout]:
    fine = dataclasses.replace(sampling if quick else FINE, resolution="standard")
    questions = [(layout, each) for each in (sampling, fine) for layout in layouts]
    for (layout, each), bound in zip(questions, judge(questions), strict=True):
        yield JudgedLayout(sweep, layout, each, bound)


def _percentiles(values: np.ndarray) -> tuple[float, float, float]:
    median, most, worst = np.percentile(values, (50, 90, 100)).tolist()
    return median, most, worst
