"""Cases of electrodes of extreme sizes and positions, and of extreme cells."""

import dataclasses
from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from eitskin.benchmarks.stability.case import Case, CaseValues
from eitskin.benchmarks.stability.closed_forms import block, shunt_pair
from eitskin.benchmarks.stability.electrical import OUTLINE, H, L, W, apart, bar, solved
from eitskin.geometry.design.electrode import Electrode
from eitskin.geometry.design.outline import Polygon, Rectangle
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh import check_quality, quality
from eitskin.geometry.meshing.mesh_design import CellKind, mesh_design

Spans = Sequence[tuple[float, float]]

# Arc lengths of both electrodes, from the origin counter-clockwise [m].
SPANS: dict[str, Spans] = {
    "1 um": ((0.03, 0.030001), (0.09, 0.090001)),
    "10 um and 5 mm": ((0.03, 0.03001), (0.09, 0.095)),
    "1 um apart": ((0.03, 0.035), (0.035001, 0.04)),
    "all but 10 um twice": ((0.0, 0.21), (0.21001, 0.41999)),
    "round one corner": ((0.14, 0.16), (0.3, 0.305)),
    "round two corners": ((0.14, 0.22), (0.41, 0.43)),
    "1 um short of a corner": ((0.140, 0.149999), (0.3, 0.305)),
}
REFUSED: dict[str, tuple[Spans, str]] = {
    "overlap of 10 nm": (((0.03, 0.03500001), (0.035, 0.04)), "overlap by"),
    "one on the other": (((0.03, 0.035), (0.03, 0.035)), "overlap by"),
    "0.1 um": (((0.03, 0.0300001), (0.09, 0.095)), "between 1 um and"),
    "longer than the rim": (((0.0, 0.43), (0.1, 0.105)), "less than the outline's perimeter"),
}


def electrodes(quick: bool) -> Iterator[Case]:
    """Cases of shunt electrodes against the closed form, touching ones, and impossible ones."""
    for name, spans in list(SPANS.items())[:: 3 if quick else 1]:
        yield Case("electrodes", name, partial(_shunt, spans))
    for name in () if quick else ("10 um and 5 mm", "round one corner", "1 um short of a corner"):
        solve = partial(_shunt, SPANS[name], "prisms")
        yield Case("electrodes", f"{name}, prisms", solve)
    touching = partial(_unknown, ((0.03, 0.035), (0.035, 0.04)))
    yield Case("electrodes", "touching, z = 1e-3", touching)
    for name, (spans, says) in REFUSED.items():
        yield Case("electrodes", name, partial(_unknown, spans), "refused", says)


def pair(spans: Spans, z: complex) -> SensorDesign:
    """Block with two electrodes of contact impedance z [ohm m2] over spans of its rim [m]."""
    places = [OUTLINE.at(0.5 * (a + b)).tolist() for a, b in spans]
    widths = [b - a for a, b in spans]
    electrodes = (Electrode(x, y, w, z) for (x, y), w in zip(places, widths, strict=True))
    return SensorDesign(OUTLINE, H, tuple(electrodes))


def _shunt(spans: Spans, cells: CellKind = "hexahedra") -> CaseValues:
    exact = shunt_pair(L, W, OUTLINE.at(np.ravel(spans)).tolist()) / H
    finest = np.diff(np.ravel(spans)).min()
    share, growth = (1e-2, 1.0) if cells == "prisms" else (1e-3, 1.5)
    fine = Grading(share * finest, 2e-2, growth)
    return solved(
        pair(spans, 1e-10), ((4,), fine), lambda R, _: apart(R, np.array([exact])), cells=cells
    )


def _unknown(spans: Spans) -> CaseValues:
    """Pair of electrodes without a closed form: only the invariants hold."""
    return solved(pair(spans, 1e-3), ((4,), Grading(1e-6, 2e-2, 1.5)))


def cells(quick: bool) -> Iterator[Case]:
    """Cases of long, thin and sharp cells: blocks of known resistance, and sharp corners."""
    sizes = Grading(1e-7, 1e-2, 1.5)
    yield Case("cells", "hexahedra, 0.1 um to 10 mm", partial(_bar, OUTLINE, sizes))
    for width in (1e-3, 1e-4, 1e-5):
        needle, sizes = Rectangle(L, width), Grading(width, 1e-1, 1.0)
        name = f"{L / width:g} : 1 needle"
        yield Case("cells", f"{name}, hexahedra", partial(_bar, needle, sizes))
        sizes = Grading(min(width, 1e-3), 4e-3, 1.0)
        if width > 1e-4:
            yield Case("cells", f"{name}, prisms", partial(_bar, needle, sizes, "prisms"))
    if not quick:
        for thickness in (H, 1e-3):
            yield Case(
                "cells",
                f"{1e3 * thickness:g} mm sheet, tetrahedra",
                partial(_tetrahedra, thickness),
            )
    for degrees in (10.0, 1.0) if quick else (10.0, 1.0, 0.1):
        yield Case("cells", f"{degrees:g} deg corner, prisms", partial(_corner, degrees), None)
    yield Case("cells", "hexahedra sheared by 100", partial(_gate, 1e2))
    solve, says = partial(_gate, 1e4), "inverted or degenerate"
    yield Case("cells", "hexahedra sheared by 10000", solve, "refused", says)


def _bar(outline: Rectangle, sizes: Grading, cells: CellKind = "hexahedra") -> CaseValues:
    exact = block(outline.length, outline.width * H, 1.0, 1e-9, 1e-9)
    design = bar(1e-9, outline=outline)
    return solved(design, ((2,), sizes), lambda R, _: apart(R, np.array([exact])), cells=cells)


def _tetrahedra(thickness: float) -> CaseValues:
    design = bar(1e-9, thickness=thickness)
    exact = block(L, W * thickness, 1.0, 1e-9, 1e-9)
    sizes = Grading(2.0 * thickness, 6.0 * thickness, 1.0)
    return solved(
        design, ((2,), sizes), lambda R, _: apart(R, np.array([exact])), cells="tetrahedra"
    )


def _corner(degrees: float) -> CaseValues:
    """Triangle with one sharp corner, an electrode round it and one on the far side."""
    far = L * np.tan(np.radians(degrees))
    outline = Polygon(((0.0, 0.0), (L, 0.0), (L, far)))
    places = outline.at([0.0, 0.8 * L, L + 0.5 * far]).tolist()
    widths = (0.02, 0.01, 0.5 * far)
    electrodes = tuple(Electrode(x, y, w, 1e-3) for (x, y), w in zip(places, widths, strict=True))
    design = SensorDesign(outline, H, electrodes)
    return solved(design, ((2,), Grading(min(2e-3, 0.25 * far), 1e-2, 0.7)), cells="prisms")


def _gate(shear: float) -> CaseValues:
    """Mesh of boxes sheared along x, through the quality check of every mesh."""
    mesh = mesh_design(bar(1e-3), Grading(1e-2, 1e-2, 1.0))
    points = mesh.points + shear * mesh.points[:, [1]] * np.array([1.0, 0.0, 0.0])
    sheared = dataclasses.replace(mesh, points=points)
    check_quality(sheared)
    return CaseValues(reached=f"least scaled Jacobian {quality(sheared).scaled_jacobian:.2g}")
