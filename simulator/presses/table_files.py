"""Files of tables of presses: shipped with the package, or solved once and kept on the disk."""

import dataclasses
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from eitskin.simulator.mechanics import solved_files
from eitskin.simulator.mechanics.layer_stack import Mechanics, Stack
from eitskin.simulator.presses.correction_table import CorrectionTable
from eitskin.simulator.presses.disc_table import DiscTable
from eitskin.simulator.presses.edge_table import EdgeTable
from eitskin.simulator.presses.pair_sides import PairSides
from eitskin.simulator.presses.pair_table import PairTable
from eitskin.simulator.presses.press_store import LIBRARY, indenter_samples
from eitskin.simulator.scene.indenters import Indenter

Array = NDArray[np.float64]

# Versions of the tables: raise them whenever corrections are solved or tabulated in another way.
_VERSIONS = {
    "corrections": 3,
    "pairs": 4,
    "pair-sides": 1,
    "discs": 1,
    "edges": 2,
}
_KEPT = 3e-4  # singular values, relative to the largest, that a stored table keeps
_OF_FIELD = 4  # dimensions of the coefficients of one field
_PARTS = ("_scales", "_amplitudes", "_modes", "_shape")

AnyTable = CorrectionTable | PairTable | PairSides | DiscTable | EdgeTable
Table = TypeVar("Table", CorrectionTable, PairTable, PairSides, DiscTable, EdgeTable)


def is_shipped(name: str) -> bool:
    """Whether the table of a name comes with the package."""
    return (LIBRARY / name).is_file()


def found_file(name: str) -> Path | None:
    """File of a table, in the package or on the disk; None where there is none."""
    places = (LIBRARY, solved_files.folder())
    return next((place / name for place in places if (place / name).is_file()), None)


def kept(kind: type[Table], name: str, solve: Callable[[], Table]) -> Table:
    """Table from package or disk, or solved now and stored."""
    path = solved_files.folder() / name
    return solved_files.kept(
        path,
        lambda: read(kind, name),
        solve,
        lambda table: solved_files.write(path, dict(_arrays(table))),
    )


def read(kind: type[Table], name: str) -> Table | None:
    """Table in a file; None where there is none or it is incomplete."""
    path = found_file(name)
    values = None if path is None else _loaded(path, path.stat().st_mtime_ns)
    names = {field.name for field in dataclasses.fields(kind)}
    return kind(**values) if values is not None and names == set(values) else None


def file_name(
    kind: str,
    stack: Stack,
    mechanics: Mechanics,
    indenter: Indenter,
    size: dict[str, object],
) -> str:
    """Name of the file of a table, by everything that it depends on."""
    gel, laws = stack.sheets[stack.gel].law.shear_modulus, [sheet.law for sheet in stack.sheets]
    laws += [] if stack.gel + 1 < len(laws) else [mechanics.encapsulation]
    described = {
        "version": _VERSIONS[kind],
        **size,
        "heights": [sheet.thickness for sheet in stack.sheets],
        "laws": [
            [type(law).__name__, law.shear_modulus / gel, getattr(law, "alpha", 2.0)]
            for law in laws
        ],
        "bulk_ratio": stack.bulk_ratio,
        "substrate": stack.substrate,
        "indenter": indenter_samples(indenter),
    }
    return solved_files.file_name(kind, described)


def _arrays(table: AnyTable) -> Iterator[tuple[str, Array]]:
    """Arrays of a file: fields as amplitudes and modes (proper orthogonal decomposition)."""
    for field in dataclasses.fields(table):
        array = getattr(table, field.name)
        if array.ndim <= _OF_FIELD:
            yield field.name, array
            continue
        scales = np.sqrt(np.mean(array**2, axis=tuple(range(array.ndim - 1))))
        flat = (array / scales).reshape(-1, np.prod(array.shape[-_OF_FIELD:]))
        left, singular, modes = np.linalg.svd(flat, full_matrices=False)
        rank = max(1, int(np.count_nonzero(singular > _KEPT * singular[0])))
        yield f"{field.name}_scales", scales
        yield f"{field.name}_shape", np.array(array.shape)
        yield f"{field.name}_amplitudes", (left[:, :rank] * singular[:rank]).astype(np.float32)
        yield f"{field.name}_modes", modes[:rank].astype(np.float32)


# Specimens of one design share tables, and most scenes follow others of the same.
@lru_cache(maxsize=16)
def _loaded(path: Path, changed: int) -> dict[str, Array] | None:  # noqa: ARG001
    """Arrays of a table in a file, read again where the file has changed."""
    found = solved_files.read(path)
    if found is None:
        return None
    values = {name: array for name, array in found.items() if not name.endswith(_PARTS)}
    try:
        for shape in (name for name in found if name.endswith("_shape")):
            name = shape.removesuffix("_shape")
            scales, amplitudes, modes = (found[f"{name}{part}"] for part in _PARTS[:3])
            flat = (amplitudes @ modes).reshape(found[shape].tolist())
            values[name] = flat * scales.astype(np.float32)
    except (KeyError, ValueError):
        return None
    return values
