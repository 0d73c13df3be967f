"""Model of a real water tank against its measured voltages.

Run by `python -m eitskin.benchmarks.recordings.tank FOLDER`.

FOLDER holds `ktc2023_ref.mat` and `ktc2023_mesh_sparse.mat` of the Kuopio Tomography Challenge
2023 (Zenodo 8252370): a round tank of plain water, 32 electrodes as high as the water, so that
the problem is one of the plane. Fitted are one conductivity and one contact impedance; then, to
see what the rest of the difference is made of, a contact impedance and a place per electrode,
one width for all electrodes, and a constant per voltmeter channel.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from eitskin.benchmarks.recordings.tank_data import Tank, read_tank
from eitskin.benchmarks.recordings.tank_fit import FIRST, FITS, Fit, fit, slopes, start
from eitskin.extras import require
from eitskin.geometry.meshing.grading import Grading
from eitskin.provenance import Provenance

# The first as fine as the mesh that the challenge gives, the second the same with quadratics.
COARSER = (
    ((1,), Grading(finest=5.6e-3, coarsest=6e-3, growth=1.0)),
    ((2,), Grading(finest=5.6e-3, coarsest=6e-3, growth=1.0)),
    ((3,), Grading(finest=1e-3, coarsest=3e-2, growth=1.5)),
)
COLUMNS = (
    "fitted, cells, order",
    "numbers",
    "unknowns",
    "all",
    "driven",
    "others",
    "sigma h [mS]",
    "z sigma [mm]",
    "width [%]",
    "turned [deg]",
)


def explain(tank: Tank) -> Iterator[Fit]:
    """Fits of the tank: the first on all meshes, all others on the chosen mesh."""
    first = start(tank)
    frozen = {name: np.zeros((tank.voltages.size, len(first[name]))) for name in ("place", "width")}
    for resolution in COARSER:
        yield fit(tank, FIRST, first, frozen, resolution)
    chosen = fit(tank, FIRST, first, frozen)
    yield chosen
    by_place_and_width = slopes(tank)
    for name in FITS:
        if name != FIRST:
            yield fit(tank, name, chosen.values, by_place_and_width)


def row(one: Fit) -> str:
    """Markdown row under `COLUMNS`."""
    values = one.values
    contacts = 1e3 * (values["contact"] + values["contacts"])
    model, ((order, *_), _) = one.model, one.resolution
    parts = [100 * part for part in one.residual]
    return (
        f"| {one.name}, {len(model.mesh.cells)}, {order} | {one.unknowns} | {model.unknowns} "
        f"| {parts[0]:.2f} % | {parts[1]:.2f} % | {parts[2]:.1f} % | {1 / values['sheet'][0]:.4f} "
        f"| {contacts.min():.2g} .. {contacts.max():.2g} | {100 * values['width'][0]:.1f} "
        f"| {np.degrees(np.abs(values['place']).max()):.2f} |"
    )


def draw(tank: Tank, fits: Sequence[Fit], path: str | Path) -> None:
    """Plot measured and modelled voltages, and their differences by channel and pattern, as PNG."""
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


def main() -> None:
    """Fit, print each fit as it is found, draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="where the two .mat files are")
    parser.add_argument("--picture", type=Path, help="PNG of measured against modelled voltages")
    options = parser.parse_args()
    tank = read_tank(options.folder)
    print(f"{Provenance.now(0)}\n\n- voltages, and those that sense a driven electrode: ", end="")
    print(f"{tank.voltages.size}, {tank.driven.sum()}\n\n| {' | '.join(COLUMNS)} |")
    print("|---" * len(COLUMNS) + "|")
    fits = []
    for one in explain(tank):
        print(row(one), flush=True)
        fits.append(one)
    if options.picture is not None:
        draw(tank, [fits[len(COARSER)], fits[-1]], options.picture)


if __name__ == "__main__":
    main()
