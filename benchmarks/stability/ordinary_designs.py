"""Cases of uncommon designs at "standard": unknowns, time and memory of one frame.

Their error is the largest relative difference of flat resistances between "fast" and "standard".
"""

import multiprocessing
import resource
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np

from eitskin.benchmarks.stability.case import Case, CaseValues
from eitskin.geometry import Disc, Layer, Polygon, Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import grid, uniform
from eitskin.protocol import Protocol
from eitskin.simulator import ForwardModel

_SHEET = Rectangle(0.150, 0.060)
_GEL = 0.005
_CORNERS = ((0.0, 0.0), (0.1, 0.0), (0.1, 0.04), (0.04, 0.04), (0.04, 0.1), (0.0, 0.1))


def _designs() -> dict[str, SensorDesign]:
    disc, angle, strip = Disc(0.050), Polygon(_CORNERS), Rectangle(0.300, 0.020)
    side = uniform(_SHEET, 8)
    inside = grid(_SHEET, 2, 2, 0.006, on="inside", z=0.5 * _GEL)
    pads = grid(_SHEET, 2, 4, 0.006, on="top") + grid(_SHEET, 2, 4, 0.006, on="bottom")
    unequal = tuple(replace(e, height=1e-3 * (1 + k % 4)) for k, e in enumerate(side))
    layers = tuple(Layer(1e-3 * mm, sigma) for mm, sigma in ((1, 0.1), (3, 1.0), (1, 5.0)))
    low = tuple(replace(e, height=1e-3 * (1 + k % 4)) for k, e in enumerate(uniform(disc, 8)))
    return {
        "disc": SensorDesign(disc, _GEL, uniform(disc, 8)),
        "L": SensorDesign(angle, _GEL, uniform(angle, 8)),
        "1 mm thin": SensorDesign(_SHEET, 0.001, side),
        "20 mm thick": SensorDesign(_SHEET, 0.020, side, encapsulated_thickness=0.027),
        "32 electrodes": SensorDesign(_SHEET, _GEL, uniform(_SHEET, 32, width=0.004)),
        "four inside": SensorDesign(_SHEET, _GEL, inside),
        "eight on the side, four inside": SensorDesign(_SHEET, _GEL, side + inside),
        "pads on top and bottom": SensorDesign(_SHEET, _GEL, pads),
        "three layers": SensorDesign(_SHEET, _GEL, side, layers=layers),
        "strip of 300 x 20 mm": SensorDesign(strip, _GEL, uniform(strip, 8)),
        "electrodes 1 to 4 mm high": SensorDesign(_SHEET, _GEL, unequal),
        "disc, electrodes 1 to 4 mm high": SensorDesign(disc, _GEL, low),
    }


def ordinary_designs(quick: bool) -> Iterator[Case]:
    """Cases of designs that fit the memory, or are refused with a resolution that does."""
    designs = _designs()
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
    gigabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    fast = protocol.measure(ForwardModel(design, "fast").impedance()).real
    error = float(np.abs(fast / R - 1.0).max())
    figures = {"unknowns": model.unknowns, "s": seconds, "GB": gigabytes, "fast [%]": 100.0 * error}
    return CaseValues(
        error=error,
        figures=figures,
        reached=f"{model.unknowns:,} unknowns, {seconds:.1f} s, {gigabytes:.2f} GB",
    )
