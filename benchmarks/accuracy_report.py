"""What `bench accuracy` leaves behind: tables as CSV, and the plot of error against time."""

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from eitskin.benchmarks.accuracy import Accuracy
from eitskin.benchmarks.accuracy_plot import plot
from eitskin.benchmarks.tables import write_table
from eitskin.benchmarks.targets import TARGET_RATIO, TARGETS
from eitskin.geometry.whole_file import whole_file


def write(found: Accuracy, folder: Path) -> list[Path]:
    """Write accuracy.csv, deformed.csv and accuracy.png into `folder`, each whole."""
    paths = [folder / name for name in ("accuracy.csv", "deformed.csv", "accuracy.png")]
    rows = [dataclasses.asdict(point) for point in found.points]
    flat = [_flattened(dataclasses.asdict(row)) for row in found.deformed]
    for path, table in zip(paths, (rows, flat), strict=False):
        write_table(path, table, str(found.provenance))
    with whole_file(paths[-1]) as temporary:
        plot(found, temporary)
    return paths


def _flattened(row: dict[str, Any]) -> dict[str, Any]:
    """The same with the entries of tables within it as columns of their own."""
    flat: dict[str, Any] = {}
    for key, value in row.items():
        flat |= value if isinstance(value, dict) else {key: value}
    return flat


def misses(found: Accuracy) -> Iterable[str]:
    """A sentence for every target that was not reached."""
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
    for duel in found.duels:
        if abs(duel.other.nodes / 1e4 - 1.0) < 0.2 and duel.ratio < TARGET_RATIO:
            yield (
                f"{duel.other.family}, {duel.other.nodes} nodes: {duel.ratio:.1f} times faster, "
                f"target {TARGET_RATIO:g}"
            )
