"""Files of `bench speed`: results, a table, and the plot of error against rate."""

import dataclasses
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from eitskin.benchmarks.results import Results, write_results
from eitskin.benchmarks.speed.run import Speed
from eitskin.extras import require

HEADINGS = ("scenes", "per second", "ms, one process alone", "error, median", "largest")


def write(found: Speed, out: Path) -> list[Path]:
    """Write results, table.csv and speed.png into `out/speed`, each whole."""
    results = Results(
        name="speed",
        command=f"eitskin bench speed --seed {found.provenance.seed}" + " --quick" * found.quick,
        provenance=found.provenance,
        seconds=found.seconds,
        quick=found.quick,
        figures=dict(figures(found)),
    )
    rows = [dataclasses.asdict(each) for each in found.rates]
    return write_results(results, out, rows, {"speed.png": partial(plot, found)})


def figures(found: Speed) -> Iterator[tuple[str, float]]:
    """All figures by name; figures of a workload by the cells of the table."""
    for row in table(found):
        for heading, cell in zip(HEADINGS[1:], row[1:], strict=True):
            yield f"{row[0]} / {heading}", float(cell.removesuffix(" %"))
    if found.peer:
        yield "pyEIT.nodes", found.peer.nodes
        yield "pyEIT.scene_ms", found.peer.scene_ms
        yield "pyEIT.times_longer", found.peer_ratio
    yield "floor.million_operations", 1e-6 * found.floor.operations
    yield "floor.least_ms", found.floor.least_ms
    yield "floor.ms", found.floor.ms
    yield "floor.times_longer", found.floor.ms / found.floor.least_ms
    made = found.generation
    yield "dataset.frames", made.frames
    yield "dataset.frames_per_second", made.frames_per_second
    yield "dataset.share_percent", 100.0 * made.share
    for name, size in zip(("small", "large"), sorted(made.memory_mb), strict=True):
        yield f"memory, {name}.frames", size
        yield f"memory, {name}.mb", made.memory_mb[size]
    for each in found.frames:
        yield f"pipeline, {each.scene}.median_ms", each.median_ms
        yield f"pipeline, {each.scene}.p99_ms", each.p99_ms


def table(found: Speed) -> Iterator[tuple[str, ...]]:
    """Rows below `HEADINGS`."""
    for each in found.rates:
        yield (
            each.name,
            f"{each.scenes_per_second:.0f}",
            f"{each.scene_ms:.0f}",
            f"{100 * each.error_median:.1f} %",
            f"{100 * each.error_max:.1f} %",
        )


def sentences(found: Speed) -> Iterator[str]:
    """Sentences below the table."""
    if found.peer:
        yield (
            f"pyEIT, {found.peer.nodes} nodes: {found.peer.scene_ms:.0f} ms a scene, "
            f"{found.peer_ratio:.1f} times as long as the first workload"
        )
    else:
        yield "pyEIT is not installed and was left out: pip install 'eitskin[bench]'"
    floor, made = found.floor, found.generation
    yield (
        f"one reanalysed touch: {1e-6 * floor.operations:.0f} million operations, "
        f"{floor.least_ms:.1f} ms at the rate of a large product of matrices; it takes "
        f"{floor.ms:.1f} ms"
    )
    yield (
        f"a dataset of {made.frames} frames: {made.frames_per_second:.0f} frames/s, "
        f"{100 * made.share:.0f} % of the engine alone; "
        + ", ".join(f"{mb:.0f} MB for {size}" for size, mb in made.memory_mb.items())
    )
    for each in found.frames:
        yield f"pipeline, {each.scene}: {each.median_ms:.1f} ms a frame, p99 {each.p99_ms:.1f} ms"
    yield str(found.provenance)


def plot(found: Speed, path: Path) -> None:
    """Plot the error of a signal over scenes per second, one point per workload."""
    figure = require("matplotlib.figure", "bench").Figure(figsize=(8, 4.5), layout="constrained")
    axes = figure.subplots()
    for each in found.rates:
        least, most = 100 * each.error_median, 100 * each.error_max
        (line,) = axes.plot([each.scenes_per_second] * 2, [least, most], marker="_", ms=9)
        axes.plot(each.scenes_per_second, least, "o", color=line.get_color(), label=each.name)
    axes.set(xlabel="scenes per second, two processes", ylabel="error of the signal [%]")
    axes.set(yscale="log", xlim=(0, None))
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=120, facecolor="white")
