"""Closed triangle surfaces from files, for bodies of any shape.

The files are parsed in a child with limits: their readers take what a head says for granted.
"""

import io
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from eitskin.bounds import require_length, require_positive
from eitskin.errors import ConfigurationError, DataError
from eitskin.extras import require
from eitskin.files import read_bytes
from eitskin.reader_process import Answer, Limits, read_in_subprocess

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

MAX_BYTES: Final = 1 << 28
"""Largest size of a file [bytes], that of five million triangles."""

SECONDS: Final = 20
"""Processor time for the smallest of files [s]."""

_BYTES_PER_SECOND: Final = 1_000_000
_MEMORY, _MEMORY_PER_BYTE = 400 << 20, 40  # [bytes]
_READER: Final = f"{__name__}:read_surface"


@dataclass(frozen=True, slots=True)
class Surface:
    """Body inside the closed triangle surface of a file (STL, OBJ, PLY, OFF ...).

    Points keep the coordinates of the file, times `scale`. An inner surface whose faces are
    oriented inwards bounds a cavity.

    Attributes:
        file: path of the surface; made absolute.
        scale: metres per unit of the file, 1e-3 for millimetres.

    Example:
        >>> from eitskin.geometry import Surface
        >>> Surface("fingertip.stl", scale=1e-3)  # doctest: +SKIP
    """

    file: Path
    scale: float = 1.0
    corner = (0.0, 0.0)

    def __post_init__(self) -> None:
        """Load the surface; raises ConfigurationError where the surface bounds no body."""
        object.__setattr__(self, "file", Path(self.file).absolute())
        require_positive("outline.scale", self.scale, "m per unit of the file")
        for name in ("length", "width", "height"):
            require_length(f"{name} of the surface {self.file.name}", getattr(self, name))

    @property
    def bounds(self) -> Array:
        """Minimum and maximum x, y, z, (2, 3) [m]."""
        points, _ = self.triangles()
        return np.stack([points.min(axis=0), points.max(axis=0)])

    @property
    def length(self) -> float:
        """Extent along x [m]."""
        return self._extent(0)

    @property
    def width(self) -> float:
        """Extent along y [m]."""
        return self._extent(1)

    @property
    def height(self) -> float:
        """Extent along z [m]."""
        return self._extent(2)

    def triangles(self) -> tuple[Array, Faces]:
        """Points (n, 3) [m] and faces (k, 3), counter-clockwise seen from outside."""
        try:
            changed = self.file.stat().st_mtime_ns
        except OSError as error:
            raise ConfigurationError(f"cannot read {self.file}: {error.strerror}") from error
        points, faces = _load(self.file, changed)
        return points * self.scale, faces

    def nearest(self, point: Array) -> tuple[Array, Array]:
        """Nearest point (3,) [m] of the surface to `point` (3,) [m], and the normal (3,) there."""
        points, faces = self.triangles()
        corners = points[faces]
        closest = require("trimesh", "mesh").triangles.closest_point(
            corners, np.broadcast_to(point, (len(faces), 3))
        )
        doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        size = np.linalg.norm(doubled, axis=1)
        gap = np.where(size > 0.0, np.linalg.norm(closest - point, axis=1), np.inf)
        face = gap.argmin()
        return closest[face], doubled[face] / size[face]

    def _extent(self, axis: int) -> float:
        return float(np.ptp(self.bounds[:, axis]))


@lru_cache(maxsize=8)
def _load(path: Path, changed: int) -> tuple[Array, Faces]:  # noqa: ARG001
    """Checked points and faces of a file; `changed` is its time of modification."""
    require("trimesh", "mesh")
    content = read_bytes(path, MAX_BYTES)
    limits = Limits(
        SECONDS + len(content) // _BYTES_PER_SECOND, _MEMORY + _MEMORY_PER_BYTE * len(content)
    )
    try:
        (answer,) = read_in_subprocess(_READER, path.name, content, limits)
    except (DataError, ImportError) as error:
        raise ConfigurationError(
            f"cannot read {path} as a surface: {error}; expected a triangle surface such as STL, "
            "OBJ, PLY or OFF"
        ) from error
    points, faces = answer.arrays["points"], answer.arrays["faces"]
    points.flags.writeable = faces.flags.writeable = False
    return points, faces


def read_surface(name: str, content: bytes) -> Iterator[Answer]:
    """Points and faces of a file's content, as a reader for `read_in_subprocess`.

    Raises ConfigurationError where they bound no body, and errors of any class for other files.
    """
    trimesh = require("trimesh", "mesh")
    mesh = trimesh.load_mesh(io.BytesIO(content), file_type=Path(name).suffix.lstrip("."))
    points, faces = np.array(mesh.vertices, dtype=float), np.array(mesh.faces, dtype=np.int64)
    _require_closed(name, mesh, faces)
    yield Answer(arrays={"points": points, "faces": faces})


def _require_closed(name: str, mesh: Any, faces: Faces) -> None:
    """Raise ConfigurationError unless the trimesh `mesh` is the boundary of one body."""
    if not len(faces):
        raise ConfigurationError(
            f"{name} holds no triangles; expected the closed surface of a body"
        )
    if not mesh.is_watertight:
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        _, counts = np.unique(edges, axis=0, return_counts=True)
        raise ConfigurationError(
            f"the surface in {name} is open: {(counts != 2).sum()} of its edges do not lie between "
            "two triangles; fill the holes and merge coincident points"
        )
    if not mesh.is_winding_consistent:
        raise ConfigurationError(
            f"the triangles in {name} look both ways: neighbours run through their common edge in "
            "the same direction; make the normals consistent and outward"
        )
    shells = mesh.split(only_watertight=False)
    outer = [shell for shell in shells if shell.volume > 0.0]
    if not outer:
        raise ConfigurationError(f"the surface in {name} is inside out; flip its triangles")
    if len(outer) > 1:
        raise ConfigurationError(
            f"{name} holds {len(outer)} bodies; a sensor is one: join them or keep the largest"
        )
    if (mesh.bounds != outer[0].bounds).any():
        raise ConfigurationError(
            f"{name} holds an inside-out surface that is no cavity of its body; flip or remove it"
        )
