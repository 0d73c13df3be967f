"""Water tank of the Kuopio Tomography Challenge 2023, read from its files."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

from eitskin.errors import DataError
from eitskin.protocol import Protocol

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Tank:
    """Voltages of a round tank.

    Attributes:
        radius: [m].
        angles: of the electrodes' middles, counter-clockwise and evenly spaced, (L,) [rad].
        width: of an electrode [rad].
        currents: injected, one pattern per column, each into one electrode and out of another,
            (L, patterns) [mA].
        senses: electrode differences that the voltmeter reads, (L, channels).
        voltages: (channels, patterns) [V].
    """

    radius: float
    angles: Array
    width: float
    currents: Array
    senses: Array
    voltages: Array

    @cached_property
    def driven(self) -> NDArray[np.bool_]:
        """Mask of the voltages that sense a current-carrying electrode, (channels, patterns)."""
        return (np.abs(self.senses).T @ np.abs(self.currents)) > 0

    @cached_property
    def protocol(self) -> Protocol:
        """Protocol of all voltages, channel by channel for each pattern."""
        drive = zip(self.currents.argmax(axis=0), self.currents.argmin(axis=0), strict=True)
        sense = list(zip(self.senses.argmax(axis=0), self.senses.argmin(axis=0), strict=True))
        rows = [(*pair, *channel) for pair in drive for channel in sense]
        return Protocol.from_rows(rows, len(self.angles))

    @cached_property
    def amplitudes(self) -> Array:
        """Current amplitude of each measurement [mA], (channels * patterns,)."""
        return np.repeat(self.currents.max(axis=0), self.voltages.shape[0])


def read_tank(folder: str | Path) -> Tank:
    """Read the tank's geometry and voltages; raises DataError where they cannot be used."""
    voltages = _load(Path(folder) / "ktc2023_ref.mat", ("Injref", "Mpat", "Uelref"))
    mesh = _load(Path(folder) / "ktc2023_mesh_sparse.mat", ("g", "elfaces"))
    currents, senses = (voltages[name].astype(np.float64) for name in ("Injref", "Mpat"))
    places = np.asarray(mesh["g"], dtype=np.float64) @ [1.0, 1.0j]
    rims = [np.unique(np.asarray(faces, dtype=np.int64)) for faces in mesh["elfaces"].ravel()]
    middles = np.angle([places[rim].sum() for rim in rims])
    widths = [
        np.ptp(np.angle(places[rim] * np.exp(-1j * m)))
        for rim, m in zip(rims, middles, strict=True)
    ]
    turns = np.mod(np.diff(middles, append=middles[0]), 2 * np.pi)
    if not np.allclose(turns, 2 * np.pi / len(rims), atol=1e-3):
        raise DataError("expected electrodes counter-clockwise at equal distances")
    if not all(np.all(((p > 0).sum(0) == 1) & ((p < 0).sum(0) == 1)) for p in (currents, senses)):
        raise DataError("expected each pattern to have one positive and one negative electrode")
    shape = (currents.shape[1], senses.shape[1])
    if voltages["Uelref"].size != np.prod(shape):
        raise DataError(
            f"expected {shape[0]} patterns x {shape[1]} channels of voltages, got "
            f"{voltages['Uelref'].size}"
        )
    return Tank(
        radius=float(np.abs(places).max()),
        angles=middles[0] + 2 * np.pi / len(rims) * np.arange(len(rims)),
        width=float(np.mean(widths)),
        currents=currents,
        senses=senses,
        voltages=np.asarray(voltages["Uelref"], dtype=np.float64).reshape(shape).T,
    )


def _load(path: Path, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    try:
        content = loadmat(path)
    except (OSError, ValueError, NotImplementedError) as error:
        raise DataError(f"cannot read {path}: {error}") from error
    missing = [name for name in names if name not in content]
    if missing:
        raise DataError(f"{path} must hold {', '.join(names)}; {', '.join(missing)} missing")
    return {name: content[name] for name in names}
