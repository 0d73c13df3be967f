"""Bodies that a user's own mesh gives: cells, named parts of the boundary, and regions."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.bounds import require_positive
from eitskin.errors import ConfigurationError
from eitskin.extras import require
from eitskin.files import require_regular
from eitskin.geometry.design.electrode import require_contact_impedance
from eitskin.geometry.design.patches import Contacts, area_vectors, boundary_faces
from eitskin.geometry.meshing.mesh import Mesh, check_quality, volumes

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Groups = Mapping[str, Indices]

_CORNERS = {"triangle": 3, "triangle6": 3, "tetra": 4, "tetra10": 4, "line": 2, "line3": 2}


@dataclass(frozen=True)
class GivenMesh:
    """Triangles in the plane or tetrahedra, as they were given.

    Attributes:
        points: (n, 2 or 3) [m].
        cells: point numbers, (m, 3 or 4).
        boundaries: named parts of the boundary: point numbers of their faces, (k, 2 or 3), or of
            points, (k,).
        regions: named sets of cells, numbers (k,).
    """

    points: Array
    cells: Indices
    boundaries: Groups
    regions: Groups

    @classmethod
    def from_mesh(cls, mesh: Any) -> "GivenMesh":
        """Mesh of a file, of `meshio` or `skfem`, or a pair of points and cells.

        Raises ConfigurationError for anything else, and for other cells.
        """
        if isinstance(mesh, str | Path):
            require_regular(path := Path(mesh), 1 << 32)
            try:
                with redirect_stdout(None), redirect_stderr(None):
                    mesh = require("meshio", "mesh").read(path)
            except (Exception, SystemExit) as error:  # of meshio for damaged files
                raise ConfigurationError(f"cannot read the mesh {path}: {error}") from error
        if hasattr(mesh, "cells_dict"):
            return cls._from_meshio(mesh)
        if hasattr(mesh, "facets") and hasattr(mesh, "t"):
            named = {n: mesh.facets.T[np.asarray(f)] for n, f in (mesh.boundaries or {}).items()}
            return cls._from_checked_arrays(mesh.p.T, mesh.t.T, named, mesh.subdomains or {})
        try:
            points, cells = mesh
        except (TypeError, ValueError) as error:
            raise ConfigurationError(
                "expected a mesh of skfem or meshio, the path of a file that meshio reads, or a "
                f"pair of points and cells, got {type(mesh).__name__}"
            ) from error
        return cls._from_checked_arrays(points, cells, {}, {})

    @classmethod
    def _from_checked_arrays(
        cls, points: ArrayLike, cells: ArrayLike, boundaries: Groups, regions: Groups
    ) -> "GivenMesh":
        x, cell = np.asarray(points, dtype=float), np.asarray(cells, dtype=np.int64)
        if cell.ndim == 2 and cell.shape[1] == 3 and x.shape[1] == 3 and not np.ptp(x[:, 2]):
            x = x[:, :2]
        if cell.ndim != 2 or x.ndim != 2 or (x.shape[1], cell.shape[1]) not in ((2, 3), (3, 4)):
            raise ConfigurationError(
                "expected triangles in a plane, points (n, 2) and cells (m, 3), or tetrahedra, "
                f"(n, 3) and (m, 4), got {x.shape} and {cell.shape}"
            )
        return cls(x, cell, dict(boundaries), dict(regions))

    @classmethod
    def _from_meshio(cls, mesh: Any) -> "GivenMesh":
        kinds = mesh.cells_dict.keys() & _CORNERS
        blocks = {k: np.asarray(mesh.cells_dict[k])[:, : _CORNERS[k]] for k in kinds}
        inner = next((k for k in ("tetra", "tetra10", "triangle", "triangle6") if k in blocks), "")
        if not inner:
            raise ConfigurationError(
                f"expected triangles or tetrahedra, got {', '.join(mesh.cells_dict) or 'no cells'}"
            )
        groups: dict[int, dict[str, list[Indices]]] = {}
        for kind, name, chosen in _meshio_groups(mesh):
            if kind in blocks and _CORNERS[kind] in (_CORNERS[inner], _CORNERS[inner] - 1):
                numbers = np.flatnonzero(chosen) if chosen.dtype == bool else chosen
                part = numbers if kind == inner else blocks[kind][numbers]
                groups.setdefault(_CORNERS[kind], {}).setdefault(name, []).append(part)
        faces, regions = (
            {name: np.concatenate(parts) for name, parts in groups.get(corners, {}).items()}
            for corners in (_CORNERS[inner] - 1, _CORNERS[inner])
        )
        sets = {name: np.asarray(each) for name, each in getattr(mesh, "point_sets", {}).items()}
        return cls._from_checked_arrays(mesh.points, blocks[inner], sets | faces, regions)


def _meshio_groups(mesh: Any) -> Iterator[tuple[str, str, NDArray[Any]]]:
    """Kind of cell, name, and numbers or mask of each named set, or of each number in cell data."""
    for name, sets in mesh.cell_sets_dict.items():
        if not name.startswith("gmsh:"):
            yield from ((kind, name, np.asarray(chosen)) for kind, chosen in sets.items())
    names = {(int(tag), int(dim)): name for name, (tag, dim) in mesh.field_data.items()}
    for key, by_kind in mesh.cell_data_dict.items():
        for kind, data in by_kind.items():
            values = np.asarray(data)
            if key == "gmsh:geometrical" or values.dtype.kind not in "iu" or values.ndim != 1:
                continue
            for tag in np.unique(values).tolist():
                name = names.get((tag, _CORNERS.get(kind, 1) - 1), str(tag))
                if name not in mesh.cell_sets_dict:
                    yield kind, name, values == tag


@dataclass(frozen=True, eq=False)
class MeshBody:
    """Body of a given mesh with electrodes on its boundary, in place of a design.

    Attributes:
        electrodes: name of each electrode.
        contact_impedance: contact impedance of the electrodes, (electrodes,) [ohm m2].
        conductivity: a number, (cells,) or f(x) [S/m].
        mesh: mesh of the body; triangles are prisms of one layer.
        given: the mesh as it was given.
        used: number of each point of the given mesh that a cell has, (points,).
    """

    electrodes: tuple[str, ...]
    contact_impedance: NDArray[np.inexact]
    conductivity: Any
    mesh: Mesh
    given: GivenMesh
    used: Indices

    layers = ()

    @classmethod
    def from_mesh(
        cls,
        mesh: Any,
        electrodes: Sequence[str | ArrayLike] | None,
        conductivity: Any,
        contact_impedance: ArrayLike,
        thickness: float,
    ) -> "MeshBody":
        """Body of a mesh; arguments and errors as for `ForwardModel.from_mesh`."""
        require_positive("thickness", thickness, "m")
        given_mesh = GivenMesh.from_mesh(mesh)
        plane = given_mesh.cells.shape[1] == 3
        used, cells = np.unique(given_mesh.cells, return_inverse=True)
        points, cells = given_mesh.points[used], cells.reshape(given_mesh.cells.shape)
        if plane:
            heights = np.array([0.0, thickness])
            points = np.column_stack([np.repeat(points, 2, axis=0), np.tile(heights, len(points))])
            cells = np.hstack([2 * cells, 2 * cells + 1])
        inverted = volumes(points, cells) < 0
        swapped = [0, 2, 1, 3, 5, 4] if plane else [0, 2, 1, 3]
        cells[inverted] = cells[inverted][:, swapped]
        named = sorted(given_mesh.boundaries, key=_natural_sort_key)
        names: Sequence[str | ArrayLike] = named if electrodes is None else electrodes
        numbers = np.full(len(given_mesh.points), -1)
        numbers[used] = np.arange(len(used))
        contacts = _contacts(points, cells, 1 + plane, list(_faces(given_mesh, names, numbers)))
        whole = Mesh(points, cells, contacts, heights if plane else None)
        check_quality(whole)
        z = np.broadcast_to(np.asarray(contact_impedance), len(names))
        for each in z.tolist():
            require_contact_impedance(each)
        labels = tuple(n if isinstance(n, str) else str(k) for k, n in enumerate(names))
        return cls(labels, z, _cell_conductivity(given_mesh, conductivity), whole, given_mesh, used)

    def values_on_given_mesh(self, values: NDArray[np.inexact]) -> NDArray[np.inexact]:
        """Values at the points of the given mesh, of those of `mesh`; NaN where no cell is."""
        full = np.full((len(self.given.points), *values.shape[1:]), np.nan, dtype=values.dtype)
        full[self.used] = values[:: len(values) // len(self.used)]
        return full

    def evaluate_conductivity(self, points: Array) -> NDArray[np.inexact]:
        """Conductivity at points (..., 3) [m], of a number or function; (...) [S/m]."""
        known = self.conductivity
        return np.asarray(known(points) if callable(known) else np.full(points.shape[:-1], known))

    @property
    def outline(self) -> "MeshOutline":
        """The body seen from above."""
        plane = self.given.cells.shape[1] == 3
        if plane:
            return MeshOutline(self.given.points, self.given.cells)
        faces, _ = boundary_faces(self.mesh.cells)
        return MeshOutline(self.mesh.points[:, :2], faces)


@dataclass(frozen=True, eq=False)
class MeshOutline:
    """Plane figure that triangles cover: points (n, 2) [m], and triangles (m, 3) of them."""

    points: Array
    triangles: Indices

    @cached_property
    def corner(self) -> tuple[float, float]:
        """Least x and least y [m]."""
        x, y = self.points[np.unique(self.triangles)].min(axis=0)
        return float(x), float(y)

    @property
    def length(self) -> float:
        """Extent along x [m]."""
        return float(np.ptp(self.points[np.unique(self.triangles), 0]))

    @property
    def width(self) -> float:
        """Extent along y [m]."""
        return float(np.ptp(self.points[np.unique(self.triangles), 1]))

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Whether points (..., 2) [m] are in a triangle, (...)."""
        flat = np.reshape(points, (-1, 2))
        a, b, c = np.moveaxis(self.points[self.triangles], 1, 0)
        inside = np.zeros(len(flat), dtype=bool)
        for start in range(0, len(flat), 256):  # bounds the memory
            part = flat[start : start + 256, None]
            turns = [_turn(first, second, part) for first, second in ((a, b), (b, c), (c, a))]
            on_left, on_right = (np.all([s * t >= 0 for t in turns], axis=0) for s in (1, -1))
            inside[start : start + 256] = ((on_left | on_right) & (_turn(a, b, c) != 0)).any(axis=1)
        return inside.reshape(np.shape(points)[:-1])


def _turn(a: Array, b: Array, p: Array) -> Array:
    """Twice the signed area of triangles a, b, p."""
    turn: Array = np.asarray(
        (b[..., 0] - a[..., 0]) * (p[..., 1] - a[..., 1])
        - (b[..., 1] - a[..., 1]) * (p[..., 0] - a[..., 0])
    )
    return turn


def _natural_sort_key(name: str) -> list[tuple[int, str]]:
    """Key that puts e2 before e10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def _faces(
    mesh: GivenMesh, electrodes: Iterable[Any], numbers: Indices
) -> Iterator[tuple[str, Indices]]:
    """Name of each electrode, and the points of its faces (k, 2 or 3) or its points (k,)."""
    if not electrodes:
        raise ConfigurationError(
            "expected a mesh with named parts of its boundary, got none; give the point numbers of "
            "each electrode as electrodes="
        )
    for number, each in enumerate(electrodes):
        if isinstance(each, str) and each not in mesh.boundaries:
            raise ConfigurationError(
                f"the boundary of the mesh has no part '{each}'; it has "
                f"{', '.join(mesh.boundaries) or 'none that is named'}"
            )
        faces = np.asarray(mesh.boundaries[each] if isinstance(each, str) else each)
        if faces.dtype.kind not in "iu" or not (0 <= faces.min(initial=0)) or not faces.size:
            raise ConfigurationError(
                f"expected names, or point numbers from 0, of electrodes, got {each!r}"
            )
        if faces.max() >= len(numbers):
            raise ConfigurationError(
                f"electrode {number} has point {faces.max()}, the mesh {len(numbers)} points"
            )
        yield str(each) if isinstance(each, str) else str(number), numbers[faces]


def _contacts(
    points: Array, cells: Indices, levels: int, electrodes: list[tuple[str, Indices]]
) -> Contacts:
    """Whole boundary faces as contacts of the electrodes; raises ConfigurationError."""
    faces, owners = boundary_faces(cells)
    if levels == 2:  # the upright faces of prisms
        upright = faces[:, -1] != faces[:, -2]
        faces, owners = faces[upright], owners[upright]
    rims = faces[:, :2] // 2 if levels == 2 else faces
    numbers = {tuple(sorted(rim)): number for number, rim in enumerate(rims.tolist())}
    taken: dict[int, str] = {}
    chosen = []
    for name, given in electrodes:
        if given.ndim == 1:
            mine = np.flatnonzero(np.isin(rims, given).all(axis=1))
        else:
            mine = np.array([numbers.get(tuple(sorted(rim)), -1) for rim in given.tolist()])
        if not len(mine) or mine.min() < 0:
            raise ConfigurationError(
                f"electrode {name} needs whole faces of the boundary: name those, or all points of "
                "at least one of them; single points, and faces inside, have no contact area"
            )
        shared = [taken[face] for face in mine.tolist() if face in taken]
        if shared:
            raise ConfigurationError(f"electrodes {shared[0]} and {name} share a face; part them")
        taken |= dict.fromkeys(mine.tolist(), name)
        chosen.append(np.unique(mine))
    every = np.concatenate(chosen)
    corners = points[faces[every]]
    return Contacts(
        np.repeat(np.arange(len(chosen)), [len(each) for each in chosen]),
        owners[every],
        corners,
        np.linalg.norm(area_vectors(corners), axis=1),
        tuple(faces[each] for each in chosen),
    )


def _cell_conductivity(mesh: GivenMesh, conductivity: Any) -> Any:
    """Conductivity of regions as one number for each cell; any other as it is."""
    if not isinstance(conductivity, Mapping):
        return conductivity
    found = np.full(len(mesh.cells), np.nan, dtype=np.result_type(float, *conductivity.values()))
    for region, value in conductivity.items():
        if region not in mesh.regions:
            raise ConfigurationError(
                f"the mesh has no region '{region}'; it has {', '.join(mesh.regions) or 'none'}"
            )
        found[mesh.regions[region]] = value
    if np.isnan(found).any():
        raise ConfigurationError(
            f"{np.isnan(found).sum()} cells are in no region of a known conductivity; the regions "
            f"are {', '.join(mesh.regions)}"
        )
    return found
