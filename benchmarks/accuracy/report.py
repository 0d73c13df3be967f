"""Files of `bench accuracy`: results, tables, and the plot of error against time."""

import dataclasses
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from eitskin.benchmarks.accuracy.cases import TARGET_RATIO, TARGETS
from eitskin.benchmarks.accuracy.plot import plot
from eitskin.benchmarks.accuracy.run import Accuracy, ModelResult
from eitskin.benchmarks.results import Results, write_results, write_table

NAME = "accuracy"


def write(found: Accuracy, out: Path) -> list[Path]:
    """Write results, table.csv, deformed.csv and accuracy.png into `out/accuracy`, each whole."""
    flat = [_flattened(dataclasses.asdict(row)) for row in found.deformed]
    results = Results(
        name=NAME,
        command=f"eitskin bench accuracy --seed {found.provenance.seed}" + " --quick" * found.quick,
        provenance=found.provenance,
        seconds=found.seconds,
        quick=found.quick,
        figures=dict(figures(found)),
    )
    rows = [dataclasses.asdict(point) for point in found.points]
    deformed = partial(write_table, rows=flat, comment=str(found.provenance))
    draw = {"deformed.csv": deformed, "accuracy.png": partial(plot, found)}
    return write_results(results, out, rows, draw)


def figures(found: Accuracy) -> Iterator[tuple[str, float]]:
    """All figures by name: points by family and name, duels by the peer's family."""
    yield "references.resistance_error", found.resistance_error
    yield "references.signal_error", found.signal_error
    for point in found.results:
        yield from _figures_of(f"{point.family}, {point.name}", point)
    for duel in found.duels:
        peer = f"{duel.other.family}, {duel.other.name}"
        yield from _figures_of(peer, duel.other)
        yield from _figures_of(f"ours on the nodes of {peer}", duel.own)
        yield f"{peer}.times_longer", duel.ratio
    for row in found.deformed:
        yield f"bent and pressed, {row.name}.frame_ms", 1e3 * row.frame_seconds
        yield f"bent and pressed, {row.name}.largest of presses", row.press_error
        if row.shear_error is not None:
            yield f"bent and pressed, {row.name}.largest of shears", row.shear_error
        for scene, error in row.signal_errors.items():
            yield f"bent and pressed, {row.name}.{scene}", error


def _figures_of(label: str, point: ModelResult) -> Iterator[tuple[str, float]]:
    yield f"{label}.nodes", point.nodes
    yield f"{label}.unknowns", point.unknowns
    yield f"{label}.frame_ms", 1e3 * point.frame_seconds
    yield f"{label}.setup_seconds", point.setup_seconds
    yield f"{label}.resistance_error", point.resistance_error
    yield f"{label}.signal_error", point.signal_error
    if point.published_error is not None:
        yield f"{label}.published_error", point.published_error


def _flattened(row: dict[str, Any]) -> dict[str, Any]:
    """Flat copy of a row: entries of nested tables become columns."""
    flat: dict[str, Any] = {}
    for key, value in row.items():
        flat |= value if isinstance(value, dict) else {key: value}
    return flat


def misses(found: Accuracy) -> Iterable[str]:
    """Sentences, one for every target that was not reached."""
    named = {point.name: point for point in found.results if point.family == "hexahedra, named"}
    for target in TARGETS:
        point = named.get(target.name)
        if point is None:
            continue
        limits = (
            ("error of R", point.resistance_error, target.resistance_error),
            ("signal error", point.signal_error, target.signal_error),
            ("seconds per frame", point.frame_seconds, target.seconds),
        )
        for quantity, value, limit in limits:
            if limit is not None and value > limit:
                yield f"{target.name}: {quantity} {value:.2g}, target {limit:g}"
    deformed = {row.name: row for row in found.deformed}
    for target in TARGETS:
        if target.name in deformed:
            row = deformed[target.name]
            for kind, error in (("presses", row.press_error), ("shears", row.shear_error)):
                if error is not None and error > target.deformed_error:
                    limit = target.deformed_error
                    yield f"{target.name}: error of {kind} {error:.2g}, target {limit:g}"
    for duel in found.duels:
        if abs(duel.other.nodes / 1e4 - 1.0) < 0.2 and duel.ratio < TARGET_RATIO:
            yield (
                f"{duel.other.family}, {duel.other.nodes} nodes: {duel.ratio:.1f} times faster, "
                f"target {TARGET_RATIO:g}"
            )
