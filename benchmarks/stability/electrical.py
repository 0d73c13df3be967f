"""Cases of extreme conductivities, contacts, layers and electrodes.

Always true: power is not given back; the power put in is the power that body and contacts turn
into heat; by the other factorisation, the one with which sensitivities are computed.
"""

import cmath
import dataclasses
import math
import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.results import peak_memory_mb
from eitskin.benchmarks.stability.case import Case, CaseValues
from eitskin.benchmarks.stability.closed_forms import block, shunt_pair
from eitskin.geometry import Disc, Electrode, Layer, Polygon, Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import grid, uniform
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh_design import CellKind
from eitskin.simulator import ForwardModel, Protocol
from eitskin.simulator.electrical.resolution import Discretisation, Resolution
from eitskin.simulator.linalg.sparse_structure import OrderName

Array = NDArray[np.float64]
Numbers = NDArray[np.inexact]

L, W, H = 0.15, 0.06, 0.005  # of the block [m]
OUTLINE = Rectangle(L, W)
AREA = W * H
_ANGLE = ((0.0, 0.0), (0.1, 0.0), (0.1, 0.04), (0.04, 0.04), (0.04, 0.1), (0.0, 0.1))
COARSE = Grading(finest=2e-2, coarsest=2e-2, growth=1.0)


def imbalance(model: ForwardModel, conductivity: Array | None = None) -> float:
    """Worst relative violation of passivity and of the power balance of a sensor.

    No currents give power: Re Z has no negative eigenvalue. And by Tellegen's theorem the
    impedance of every pair is

        R = int sigma |grad u|^2 dV + sum_l int z_l j^2 dS = -sum_c sigma_c dR/d sigma_c
            + sum_l z_l dR/dz_l.
    """
    protocol = Protocol.pairwise(len(model.design.electrodes))
    mesh = model.mesh
    middles = mesh.points[mesh.cells].mean(axis=1)
    sigma = model.design.evaluate_conductivity(middles) if conductivity is None else conductivity
    z = np.array([electrode.contact_impedance for electrode in model.design.electrodes])
    Z = model.impedance(conductivity)
    R = protocol.measure(Z)
    heat = model.contact_sensitivity(protocol, conductivity) @ z
    heat = heat - model.sensitivity(protocol, conductivity) @ sigma
    values = np.linalg.eigvalsh(np.real(Z))
    return float(max(np.abs(heat / R - 1.0).max(), -values[0] / values[-1]))


def relative_difference(first: Numbers, second: Numbers) -> float:
    """Largest relative difference between two arrays."""
    return float(np.abs(first / second - 1.0).max())


def solve_both(
    design: SensorDesign,
    resolution: Resolution | Discretisation,
    exact: Callable[[Numbers, ForwardModel], float] | complex | None = None,
    *,
    cells: CellKind | None = None,
    breaks: Sequence[float] = (),
    conductivity: Callable[[Array], Array] | None = None,
) -> CaseValues:
    """Impedances of all pairs of a sensor by both solvers, as values of a case.

    `exact` is the impedance of the only pair, or gives the error of the impedances of all pairs;
    `conductivity` gives the values at the middles (cells, 3) [m] of cells.
    """
    protocol = Protocol.pairwise(len(design.electrodes))
    impedances = []
    orders: tuple[OrderName, ...] = ("block Cholesky", "nested dissection")
    for solver in orders:
        model = ForwardModel(design, resolution, breaks, cells, solver)
        middles = model.mesh.points[model.mesh.cells].mean(axis=1)
        sigma = None if conductivity is None else conductivity(middles)
        impedances.append(protocol.measure(model.impedance(sigma)))
    if not callable(exact):
        error = None if exact is None else relative_difference(impedances[-1], np.array([exact]))
    else:
        error = exact(impedances[-1], model)
    return CaseValues(relative_difference(*impedances), imbalance(model, sigma), error)


def bar(*z: complex, layers: tuple[Layer, ...] = ()) -> SensorDesign:
    """Block between electrodes over its two whole ends x = 0 and x = length."""
    ends = (Electrode(0.0, 0.5 * W, W, z[0]), Electrode(L, 0.5 * W, W, z[-1]))
    return SensorDesign(OUTLINE, H, ends, layers=layers)


def outside(R: Numbers, low: Numbers, high: Numbers) -> float:
    """Relative distance of resistances from the interval of rigorous bounds; 0 within."""
    return float(np.maximum(low / R - 1.0, R / high - 1.0).max(initial=0.0))


# Conductivities


def contrasts(ratios: Sequence[float]) -> Iterator[Case]:
    """Cases of two conductivities in one sensor: in series, in parallel, and in two halves."""
    for ratio in ratios:
        cases = {"in series": _in_series, "in parallel": _in_parallel, "half a sensor": _half}
        for name, solve in cases.items():
            title, part = f"{name}, 1 : {ratio:g}", partial(solve, ratio)
            yield Case(title, part, invariant_limit=_contrast_limit(ratio), error_limit=1e-6)


def _contrast_limit(ratio: float) -> float:
    """Limit of an invariant: digits are lost in proportion to the contrast."""
    return 1e-11 * max(ratio, 1.0 / ratio) + 1e-10


def _in_series(ratio: float) -> CaseValues:
    exact = block(0.5 * L, AREA, 1.0, 1e-9) + block(0.5 * L, AREA, ratio, 1e-9)
    return solve_both(bar(1e-9), ((2,), COARSE), exact, **_changed_half(ratio))


def _changed_half(ratio: float) -> dict[str, Any]:
    """Options of `solve_both` for a conductivity of 1 S/m, and of `ratio` in the far half."""
    return {"breaks": (0.5 * L,), "conductivity": lambda x: np.where(x[:, 0] < 0.5 * L, 1.0, ratio)}


def _in_parallel(ratio: float, thin: float = 0.5) -> CaseValues:
    """Sheets in parallel: separate contacts conduct least, shared contacts most."""
    z, shares = 1e-9, ((1.0 - thin, 1.0), (thin, ratio))
    sheets = tuple(Layer(share * H, sigma) for share, sigma in shares)

    def together(*contact: float) -> Numbers:
        each = [1.0 / block(L, share * AREA, sigma, *contact) for share, sigma in shares]
        return np.array([1.0 / sum(each)])

    def error(R: Numbers, _: ForwardModel) -> float:
        return outside(R, together(), together(z, z))

    return solve_both(bar(z, layers=sheets), ((2, 2, 2), COARSE), error)


def _half(ratio: float) -> CaseValues:
    """Reference sensor with one changed half, bounded by none and all of it changed."""

    def error(R: Numbers, model: ForwardModel) -> float:
        protocol = Protocol.pairwise(8)
        ends = [protocol.measure(model.impedance(sigma)) for sigma in (1.0, ratio)]
        return outside(R, np.minimum(*ends), np.maximum(*ends))

    return solve_both(SensorDesign.reference(), "fast", error, **_changed_half(ratio))


# Layers


def layers(ratios: Sequence[float], shares: Sequence[float]) -> Iterator[Case]:
    """Cases of thin sheets in the stack, between pads on top and bottom and between its ends."""
    for thin in shares:
        for ratio in ratios:
            name = f"1 : {ratio:g} S/m, {1.0 / thin - 1.0:.0f} : 1"
            limit = _contrast_limit(ratio)
            for kind, solve in (("across", _cross_layer_case), ("along", _in_parallel)):
                part = partial(solve, ratio, thin)
                # Rounding decides where contrasts of conductivities and heights multiply to 1e9.
                expected: Literal["ok"] | None = None if ratio > 1e5 and thin < 2e-3 else "ok"
                yield Case(
                    f"{kind}, {name}", part, expected, "double precision", math.inf, limit, 1e-7
                )


def _cross_layer_case(ratio: float, thin: float) -> CaseValues:
    faces = tuple(Electrode(L / 2, W / 2, L, 1e-9, height=W, on=on) for on in ("top", "bottom"))
    sheets = (Layer((1.0 - thin) * H, 1.0), Layer(thin * H, ratio))
    exact = H * (1.0 - thin + thin / ratio) / (L * W) + 2e-9 / (L * W)
    design = SensorDesign(OUTLINE, H, faces, layers=sheets)
    return solve_both(design, ((1, 1), COARSE), exact)


# Contacts


def contacts() -> Iterator[Case]:
    """Cases of contact impedances from 1e-9 to 1e3 ohm m2, equal and mixed, and beyond."""
    pairs: list[tuple[complex, complex]] = [(z, z) for z in (1e-10, 1e-9, 1e-6, 1e-3, 1.0, 1e3)]
    pairs += [(1e-9, 1e3), (1e-9, 1e-3 + 1e3j), (1e3, 1e-3 - 4e-3j)]
    pairs += [(cmath.rect(z, 1.5), cmath.rect(z, -1.5)) for z in (1e-9, 1e-3, 1e3)]
    for first, second in pairs:
        name = ", ".join(f"{z:.1g}" for z in dict.fromkeys((first, second)))
        yield Case(f"block, {name}", partial(_bar, (first, second)))
    for z in (1e-9, 1e-3, 1e3, 1e3 * cmath.exp(1.5j)):
        yield Case(f"{z:.2g}, but 1e6 before one", partial(_buried_case, z))
    for sigma in (1.0, 1e-2, 1e-4):
        name = f"2 mm high, 1e-09, {sigma:g} S/m"
        # The part shared by all heights and the part of one height cancel: 2e-18 m / (z sigma).
        yield Case(name, partial(_strips, sigma), invariant_limit=1e-4)
    for bad in (0.0, 1e-11, 1e7, -1e-3, 1e-3j, float("nan"), float("inf")):
        solve = partial(_bar, (bad, bad))
        yield Case(f"{bad:.2g}", solve, "refused", "contact_impedance must be")


def _bar(z: tuple[complex, complex]) -> CaseValues:
    """Block whose own resistance L / (sigma A) must stay accurate next to large contacts."""

    def error(R: Numbers, _: ForwardModel) -> float:
        return relative_difference(R - sum(z) / AREA, np.array([L / AREA]))

    return solve_both(bar(*z), ((2,), COARSE), error)


def _strips(sigma: float) -> CaseValues:
    """Electrodes that do not cover the full thickness, without a closed form."""
    places = (0.03, 0.09)
    strips = tuple(Electrode(x, 0.0, 0.005, 1e-9, height=0.002) for x in places)
    return solve_both(SensorDesign(OUTLINE, H, strips, conductivity=sigma), "fast")


def _buried_case(z: complex) -> CaseValues:
    """Reference sensor with one electrode behind 1e6 ohm m2, compared with none there."""
    sensor = SensorDesign.reference()
    changed = [dataclasses.replace(e, contact_impedance=z) for e in sensor.electrodes]
    other_electrodes = dataclasses.replace(sensor, electrodes=tuple(changed[1:]))
    changed[0] = dataclasses.replace(changed[0], contact_impedance=1e6)
    whole = dataclasses.replace(sensor, electrodes=tuple(changed))

    def error(R: Numbers, _: ForwardModel) -> float:
        # The first seven pairs are those of electrode 0.
        alone = ForwardModel(other_electrodes, "fast").impedance()
        return relative_difference(R[7:], Protocol.pairwise(7).measure(alone))

    return solve_both(whole, "fast", error)


# Electrodes of extreme sizes and positions

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
REFUSED_DESIGNS: dict[str, tuple[Spans, str]] = {
    "overlap of 10 nm": (((0.03, 0.03500001), (0.035, 0.04)), "overlap by"),
    "one on the other": (((0.03, 0.035), (0.03, 0.035)), "overlap by"),
    "0.1 um": (((0.03, 0.0300001), (0.09, 0.095)), "between 1 um and"),
    "longer than the rim": (((0.0, 0.43), (0.1, 0.105)), "less than the outline's perimeter"),
}


def electrodes(quick: bool) -> Iterator[Case]:
    """Cases of shunt electrodes against the closed form, touching ones, and impossible ones."""
    for name, spans in list(SPANS.items())[:: 3 if quick else 1]:
        yield Case(name, partial(_shunt, spans))
    for name in () if quick else ("10 um and 5 mm", "round one corner", "1 um short of a corner"):
        solve = partial(_shunt, SPANS[name], "prisms")
        yield Case(f"{name}, prisms", solve)
    touching = partial(_pair_case, ((0.03, 0.035), (0.035, 0.04)))
    yield Case("touching, z = 1e-3", touching)
    for name, (spans, says) in REFUSED_DESIGNS.items():
        yield Case(name, partial(_pair_case, spans), "refused", says)


def pair(spans: Spans, z: complex) -> SensorDesign:
    """Block with two electrodes of contact impedance z [ohm m2] over spans of its rim [m]."""
    places = [OUTLINE.rim_points(0.5 * (a + b)).tolist() for a, b in spans]
    widths = [b - a for a, b in spans]
    electrodes = (Electrode(x, y, w, z) for (x, y), w in zip(places, widths, strict=True))
    return SensorDesign(OUTLINE, H, tuple(electrodes))


def _shunt(spans: Spans, cells: CellKind = "hexahedra") -> CaseValues:
    exact = shunt_pair(L, W, OUTLINE.rim_points(np.ravel(spans)).tolist()) / H
    finest = np.diff(np.ravel(spans)).min()
    share, growth = (1e-2, 1.0) if cells == "prisms" else (1e-3, 1.5)
    fine = Grading(share * finest, 2e-2, growth)
    return solve_both(pair(spans, 1e-10), ((4,), fine), exact, cells=cells)


def _pair_case(spans: Spans) -> CaseValues:
    """Pair of electrodes without a closed form: only the invariants hold."""
    return solve_both(pair(spans, 1e-3), ((4,), Grading(1e-6, 2e-2, 1.5)))


def _uncommon_designs() -> dict[str, SensorDesign]:
    disc, angle, strip = Disc(0.050), Polygon(_ANGLE), Rectangle(0.300, 0.020)
    side = uniform(OUTLINE, 8)
    inside = grid(OUTLINE, 2, 2, 0.006, on="inside", z=0.5 * H)
    pads = grid(OUTLINE, 2, 4, 0.006, on="top") + grid(OUTLINE, 2, 4, 0.006, on="bottom")
    unequal, low = (
        tuple(dataclasses.replace(e, height=1e-3 * (1 + k % 4)) for k, e in enumerate(each))
        for each in (side, uniform(disc, 8))
    )
    layers = tuple(Layer(1e-3 * mm, sigma) for mm, sigma in ((1, 0.1), (3, 1.0), (1, 5.0)))
    return {
        "disc": SensorDesign(disc, H, uniform(disc, 8)),
        "L": SensorDesign(angle, H, uniform(angle, 8)),
        "1 mm thin": SensorDesign(OUTLINE, 0.001, side),
        "20 mm thick": SensorDesign(OUTLINE, 0.020, side, encapsulated_thickness=0.027),
        "32 electrodes": SensorDesign(OUTLINE, H, uniform(OUTLINE, 32, width=0.004)),
        "four inside": SensorDesign(OUTLINE, H, inside),
        "eight on the side, four inside": SensorDesign(OUTLINE, H, side + inside),
        "pads on top and bottom": SensorDesign(OUTLINE, H, pads),
        "three layers": SensorDesign(OUTLINE, H, side, layers=layers),
        "strip of 300 x 20 mm": SensorDesign(strip, H, uniform(strip, 8)),
        "electrodes 1 to 4 mm high": SensorDesign(OUTLINE, H, unequal),
        "disc, electrodes 1 to 4 mm high": SensorDesign(disc, H, low),
    }


def ordinary_designs(quick: bool) -> Iterator[Case]:
    """Cases of uncommon designs that fit the memory, or are refused with a resolution that does.

    Unknowns, time and memory are those of one frame at "standard"; the error is the largest
    relative difference of flat resistances between "fast" and "standard".
    """
    designs = _uncommon_designs()
    for name in ("disc",) if quick else designs:
        # A process of its own: a system remembers the most that one used.
        solve = partial(_in_process, designs[name])
        yield Case(name, solve, None, "fits this design", error_limit=5e-2)


def _in_process(design: SensorDesign) -> CaseValues:
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_measure, design).result()


def _measure(design: SensorDesign) -> CaseValues:
    """Frame at both resolutions; peak memory and processor time are those of "standard"."""
    protocol, began = Protocol.pairwise(len(design.electrodes)), time.process_time()
    model = ForwardModel(design, "standard")
    R = protocol.measure(model.impedance()).real
    seconds = time.process_time() - began
    gigabytes = 1e-3 * peak_memory_mb()
    fast = protocol.measure(ForwardModel(design, "fast").impedance()).real
    error = float(np.abs(fast / R - 1.0).max())
    figures = {"unknowns": model.unknowns, "s": seconds, "GB": gigabytes, "fast [%]": 100.0 * error}
    return CaseValues(
        error=error,
        figures=figures,
        reached=f"{model.unknowns:,} unknowns, {seconds:.1f} s, {gigabytes:.2f} GB",
    )
