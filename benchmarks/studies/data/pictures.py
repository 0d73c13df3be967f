"""Pictures without training: figures of merit of a moving target, and a real tank's pictures.

Run by `python -m eitskin.benchmarks.studies.data.pictures --out OUT [--tank FOLDER]`.

A small target moves along a radius of a disc with sixteen electrodes under the adjacent protocol,
the layout of Adler et al. 2009, solved on a mesh of its own. Each picture is judged by the figures
of merit of that paper, pyEIT's GREIT on the same data likewise. With FOLDER of the Kuopio
Tomography Challenge 2023 (see `tank_data`), two simulated targets are added to the measured
voltages of the empty tank and shown by four methods.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.results import Results, write_results
from eitskin.benchmarks.studies.data.tank_data import Tank, read_tank
from eitskin.benchmarks.studies.data.tank_fit import flat, start, tank_model
from eitskin.extras import require
from eitskin.geometry.design.outline import Disc
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.protocol import Protocol
from eitskin.provenance import Provenance
from eitskin.simulator.electrical.forward_model import ForwardModel
from eitskin.training.evaluation.report.drawing import PicturePanel, draw_panels, style
from eitskin.training.reconstruction.figures_of_merit import FiguresOfMerit, figures_of_merit
from eitskin.training.reconstruction.pixel_grid import PixelGrid
from eitskin.training.reconstruction.reconstructor import Method, Reconstructor

Array = NDArray[np.float64]
Maker = Callable[[Array, Array], tuple[PixelGrid, Array, float]]
"""From frames (n, measurements) and a reference to a grid, values of its pixels (n, P), and how far
these lie to the left of and below the grid's pixels [m]."""

RADIUS, ELECTRODES = 0.05, 16
SHARES = np.arange(0.0, 0.91, 0.05)  # distances of the target from the middle, of the radius
QUOTED = (0.0, 0.3, 0.6, 0.9)
TARGET, EDGE, CHANGE = 0.05, 0.02, 0.1  # radius and soft edge, of the disc's; change of sigma
FINE = ((3,), Grading(finest=5e-4, coarsest=2.5e-3, growth=1.5))
SHOWN: tuple[Method, ...] = ("back-projection", "noser", "laplace", "greit")
TANK_SHOWN: tuple[Method, ...] = ("back-projection", "noser", "total-variation", "greit")
FINE_TANK = ((3,), Grading(finest=1e-3, coarsest=5e-3, growth=1.5))
TANK_MESH = ((3,), Grading(finest=1e-3, coarsest=1e-2, growth=1.5))
TANK_TARGETS = ((0.075, 0.150, 0.018, -0.9), (0.155, 0.085, 0.014, 3.0))  # x, y, radius, change
TANK_NOISE = 1e-3  # of the measured voltages' root mean square


def disc_design() -> tuple[SensorDesign, Protocol]:
    """Disc with sixteen electrodes from the right counter-clockwise, and the adjacent protocol."""
    outline = Disc(RADIUS)
    electrodes = uniform(outline, ELECTRODES, width=0.1 * RADIUS, start=0.0)
    return SensorDesign(outline, 0.005, electrodes), Protocol.adjacent(ELECTRODES)


def disc(x: Array, centre: tuple[float, float], radius: float, edge: float) -> Array:
    """Disc with a soft edge, one inside and zero outside, at points (..., 3) [m]."""
    away = np.hypot(x[..., 0] - centre[0], x[..., 1] - centre[1])
    inside: Array = np.clip((radius - away) / edge + 0.5, 0.0, 1.0)
    return inside


def moving_target(design: SensorDesign, protocol: Protocol) -> tuple[Array, Array]:
    """Frames (positions, measurements) of the target, and the frame without a target [ohm]."""
    model = ForwardModel(design, FINE)
    frames = []
    for share in SHARES:
        centre = (RADIUS * (1.0 + share), RADIUS)

        def sigma(x: Array, centre: tuple[float, float] = centre) -> Array:
            return 1.0 + CHANGE * disc(x, centre, TARGET * RADIUS, EDGE * RADIUS)

        frames.append(protocol.measure(model.impedance(sigma)).real)
    return np.array(frames), protocol.measure(model.impedance()).real


def own(method: Method) -> Maker:
    """Pictures of a method of eitskin, with its defaults."""
    design, protocol = disc_design()
    maker = Reconstructor(design, protocol, method)

    def pictures(frames: Array, reference: Array) -> tuple[PixelGrid, Array, float]:
        images = maker.images(maker.data(frames, reference))
        return maker.grid, images[:, maker.grid.inside], 0.0

    return pictures


def peer() -> Maker:
    """Pictures of pyEIT's GREIT, set up as in its own example, on the pixels of its grid.

    Its disc has the radius 1, and its grid holds the lower left corners of pixels.
    """
    create = require("pyeit.mesh", "bench").create
    protocols = require("pyeit.eit.protocol", "bench")
    mesh = create(ELECTRODES, h0=0.06)
    angles = np.arctan2(*mesh.node[mesh.el_pos][:, 1::-1].T)
    pairs = protocols.create(ELECTRODES, dist_exc=1, step_meas=1, parser_meas="std")
    rows = [
        (*map(int, drive), *map(int, sense))
        for drive, senses in zip(pairs.ex_mat, pairs.meas_mat, strict=True)
        for sense in senses
    ]
    # Numbers of this layout's electrodes at the angles of pyEIT's.
    number = np.rint(np.mod(angles, 2 * np.pi) / (2 * np.pi / ELECTRODES)).astype(int) % ELECTRODES
    table = Protocol.from_rows([[int(number[e]) for e in row] for row in rows], ELECTRODES)
    solver = require("pyeit.eit.greit", "bench").GREIT(mesh, pairs)
    solver.setup(p=0.50, lamb=0.01, perm=1.0, jac_normalized=True)
    grid = PixelGrid(Disc(RADIUS), solver.xg.shape)
    order = adjacent_rows(table)

    def pictures(frames: Array, reference: Array) -> tuple[PixelGrid, Array, float]:
        signs, columns = order
        before = signs * reference[columns]
        values = []
        for frame in frames:
            change = solver.solve(signs * frame[columns], before, normalize=True)
            values.append(np.real(change).reshape(solver.xg.shape)[grid.inside])
        return grid, np.array(values), 0.5 * grid.sides[0]

    return pictures


def adjacent_rows(table: Protocol) -> tuple[Array, NDArray[np.int64]]:
    """Signs and columns of the adjacent protocol's measurements that make those of `table`."""
    known = {}
    for k, (a, b, c, d) in enumerate(disc_design()[1].table):
        for first, one in (((a, b), 1.0), ((b, a), -1.0)):
            for second, other in (((c, d), 1.0), ((d, c), -1.0)):
                known[(*first, *second)] = (one * other, k)
    found = [known[row] for row in table.table]
    return np.array([sign for sign, _ in found]), np.array([k for _, k in found])


def judged(maker: Maker, frames: Array, reference: Array) -> list[FiguresOfMerit]:
    """Figures of merit of a moving target's pictures."""
    grid, values, moved = maker(frames, reference)
    middle = RADIUS + moved
    r = np.linspace(0.0, 0.2 * RADIUS, 2001)
    profile = np.clip((TARGET * RADIUS - r) / (EDGE * RADIUS) + 0.5, 0.0, 1.0)
    integral = CHANGE * 2.0 * np.pi * float(np.trapezoid(profile * r, r))
    return [
        figures_of_merit(picture, grid, (middle + share * RADIUS, middle), integral)
        for picture, share in zip(values, SHARES, strict=True)
    ]


def columns(found: list[FiguresOfMerit]) -> dict[str, Array]:
    """Curves over the position: amplitude relative to the middle, position error by the radius."""
    amplitude = np.array([each.amplitude for each in found])
    return {
        "amplitude": amplitude / amplitude[0],
        "position error": -np.array([each.shift[0] for each in found]) / RADIUS,
        "resolution": np.array([each.resolution for each in found]),
        "shape deformation": np.array([each.shape_deformation for each in found]),
        "ringing": np.array([each.ringing for each in found]),
    }


def figures(curves: dict[str, dict[str, Array]]) -> Iterator[tuple[str, float]]:
    """Quoted values of all curves by name."""
    for name, quantities in curves.items():
        for quantity, curve in quantities.items():
            for share in QUOTED:
                value = round(float(np.interp(share, SHARES, curve)), 6) + 0.0  # no minus zero
                yield f"{name} / {quantity} at {share:g}", value


def tank_panels(tank: Tank) -> list[PicturePanel]:
    """Pictures of two simulated targets in the measured empty tank, by four methods.

    The model's change by the targets, solved with the targets in it, is added to the measured
    voltages on the scale that fits the empty model to these, with white noise.
    """
    model = tank_model(tank, start(tank), FINE_TANK)
    protocol, amplitudes = tank.protocol, tank.amplitudes

    def sigma(x: Array) -> Array:
        found = np.ones(x.shape[:-1])
        for px, py, radius, change in TANK_TARGETS:
            found += change * disc(x, (px, py), radius, 1e-3)
        return found

    empty, full = (protocol.measure(model.impedance(s)).real for s in (1.0, sigma))
    measured = flat(tank.voltages) / amplitudes
    scale = float(measured @ empty / (empty @ empty))
    noise = TANK_NOISE * np.sqrt(np.mean(measured**2))
    drawn = noise * np.random.default_rng(0).normal(size=len(measured))
    frame = measured + scale * (full - empty) + drawn
    panels = []
    for method in TANK_SHOWN:
        maker = Reconstructor(model.design, protocol, method, resolution=TANK_MESH)
        image = maker.images(maker.data(frame, measured))
        circles = tuple((x, y, radius) for x, y, radius, _ in TANK_TARGETS)
        panels.append(PicturePanel(method, model.design, maker.grid, image, circles))
        print(f"{method}: {100 * np.nanmin(image):.0f} to {100 * np.nanmax(image):.0f} %")
    return panels


def draw_curves(curves: dict[str, dict[str, Array]], path: Path) -> None:
    """Plot each figure of merit over the target's distance from the middle, as PNG."""
    make = require("matplotlib.figure", "view").Figure
    with style():
        figure = make(figsize=(11.5, 2.9), layout="constrained")
        panels = figure.subplots(1, 5)
        for axes, quantity in zip(panels, next(iter(curves.values())), strict=True):
            for name, found in curves.items():
                axes.plot(SHARES, found[quantity], label=name, linewidth=1.4)
            axes.set(title=quantity, xlim=(0.0, 0.9))
            if quantity == "position error":
                axes.set_ylim(-0.15, 0.15)
            else:
                axes.set_ylim(bottom=0.0)
        panels[2].set_xlabel("distance of the target from the middle, of the radius")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
        figure.savefig(path, dpi=110)


def draw_tank(tank: Tank, path: Path) -> None:
    """Draw the tank's pictures, as PNG."""
    with style():
        draw_panels(tank_panels(tank), columns=2, common=False).savefig(path, dpi=90)


def main() -> None:
    """Measure, print and write the figures, draw the pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of all results")
    parser.add_argument("--tank", type=Path, help="folder with the two .mat files of the tank")
    options = parser.parse_args()
    begun = time.perf_counter()
    frames, reference = moving_target(*disc_design())
    makers: dict[str, Maker] = {f"eitskin {name}": own(name) for name in SHOWN}
    makers["pyEIT greit"] = peer()
    curves = {name: columns(judged(maker, frames, reference)) for name, maker in makers.items()}
    plots: dict[str, Callable[[Path], Any]] = {"merit.png": lambda path: draw_curves(curves, path)}
    if options.tank is not None:
        tank = read_tank(options.tank)
        plots["tank.png"] = lambda path: draw_tank(tank, path)
    found = dict(figures(curves))
    for name, value in found.items():
        print(f"{name}: {value:.3f}")
    command = "python -m eitskin.benchmarks.studies.data.pictures --out OUT --tank DATA"
    seconds = time.perf_counter() - begun
    results = Results("pictures", command, Provenance.now(0), seconds, figures=found)
    write_results(results, options.out, plots=plots)


if __name__ == "__main__":
    main()
