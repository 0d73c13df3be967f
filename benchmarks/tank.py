"""A real water tank against the model: `python -m eitskin.benchmarks.tank FOLDER`.

FOLDER holds `ktc2023_ref.mat` and `ktc2023_mesh_sparse.mat` of the Kuopio Tomography Challenge
2023 (Zenodo 8252370): a round tank of plain water, 32 electrodes as high as the water, so that
the problem is one of the plane. Fitted are one conductivity and one contact impedance; then, to
see what the rest of the difference is made of, a contact impedance and a place per electrode,
one width for all electrodes, and a constant per voltmeter channel.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from eitskin.benchmarks.tank_data import Tank, read_tank
from eitskin.benchmarks.tank_fit import FIRST, FITS, RESOLUTION, Fit, fit, slopes, start
from eitskin.geometry.grading import Grading
from eitskin.geometry.optional import require

# The first as fine as the mesh that the challenge gives, the second the same with quadratics.
COARSER = (
    ((1,), Grading(finest=5.6e-3, coarsest=6e-3, growth=1.0)),
    ((2,), Grading(finest=5.6e-3, coarsest=6e-3, growth=1.0)),
    ((3,), Grading(finest=1e-3, coarsest=3e-2, growth=1.5)),
)
PARTS = f"{'all %':>10}{'driven %':>10}{'others %':>10}"
SIZES = f"{'sigma h mS':>12}{'z sigma mm':>20}{'width %':>11}{'turned deg':>12}"


def mesh_table(fits: Sequence[Fit]) -> str:
    """The same fit on several meshes, a line each."""
    lines = [f"{FIRST}, mesh by mesh", f"{'cells':>8}{'order':>7}{'unknowns':>10}" + PARTS]
    lines += [
        f"{len(one.model.mesh.cells):8}{order:7}{one.model.unknowns:10}" + _percent(one)
        for one, ((order,), _) in zip(fits, (*COARSER, RESOLUTION), strict=True)
    ]
    return "\n".join(lines)


def table(fits: Sequence[Fit]) -> str:
    """The fits, a line each."""
    lines = [f"{'fitted':40}{'numbers':>8}" + PARTS + SIZES]
    for one in fits:
        values = one.values
        contacts = 1e3 * (values["contact"] + values["contacts"])
        lines.append(
            f"{one.name:40}{one.unknowns:8}"
            + _percent(one)
            + f"{1 / values['sheet'][0]:12.4f}"
            + f"{f'{contacts.min():.2g} .. {contacts.max():.2g}':>20}"
            + f"{100 * values['width'][0]:11.1f}"
            + f"{np.degrees(np.abs(values['place']).max()):12.2f}"
        )
    return "\n".join(lines)


def _percent(one: Fit) -> str:
    return "".join(f"{100 * part:10.2f}" for part in one.residual)


def draw(tank: Tank, fits: Sequence[Fit], path: str | Path) -> None:
    """Measured against modelled voltages, and the differences by channel and pattern, as PNG."""
    require("matplotlib", "view").use("Agg")
    plt = require("matplotlib.pyplot", "view")
    figure, axes = plt.subplots(len(fits), 2, figsize=(11, 4.2 * len(fits)), squeeze=False)
    for (left, right), one in zip(axes, fits, strict=True):
        for rows, label in ((tank.driven, "senses a driven electrode"), (~tank.driven, "others")):
            left.plot(one.voltages[rows], tank.voltages[rows], ".", ms=3, label=label)
        left.axline((0, 0), slope=1, color="0.6", lw=0.8)
        left.set(xscale="symlog", yscale="symlog", xlabel="modelled [V]", ylabel="measured [V]")
        left.set_xscale("symlog", linthresh=0.02)
        left.set_yscale("symlog", linthresh=0.02)
        left.set_title(f"{one.name}: {100 * one.residual[0]:.1f} %", fontsize=10)
        left.legend(frameon=False, fontsize=8)
        image = right.imshow(
            tank.voltages - one.voltages, vmin=-0.2, vmax=0.2, cmap="RdBu_r", aspect="auto"
        )
        right.set(xlabel="current pattern", ylabel="channel", title="measured - modelled [V]")
        figure.colorbar(image, ax=right)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def run(folder: str | Path, picture: Path | None = None) -> str:
    """Fit the tank of a folder; gives the tables and draws `picture`."""
    tank = read_tank(folder)
    begin = time.perf_counter()
    by_place_and_width = slopes(tank)
    meshes = [fit(tank, FIRST, start(tank), by_place_and_width, r) for r in (*COARSER, RESOLUTION)]
    first = meshes[-1]
    others = [fit(tank, name, first.values, by_place_and_width) for name in FITS if name != FIRST]
    if picture is not None:
        draw(tank, [first, others[-1]], picture)
    return (
        f"{tank.voltages.size} voltages, {tank.driven.sum()} of which sense a driven electrode; "
        f"{time.perf_counter() - begin:.0f} s\n\n{mesh_table(meshes)}\n\n{table([first, *others])}"
    )


def main() -> None:
    """Fit, print the tables, draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__, prog="eitskin.benchmarks.tank")
    parser.add_argument("folder", type=Path, help="where the two .mat files are")
    parser.add_argument("--picture", type=Path, help="PNG of measured against modelled voltages")
    options = parser.parse_args()
    print(run(options.folder, options.picture))


if __name__ == "__main__":
    main()
