"""Meshes, electrodes, indenters and lines of current as pyvista data sets and actors."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.extras import require
from eitskin.geometry.design.patches import area_vectors
from eitskin.geometry.meshing.mesh import Mesh
from eitskin.simulator.scene.indenters import Footprint, Indenter
from eitskin.simulator.view.render import DIRECTION, MATT

Array = NDArray[np.float64]

GEL, METAL, EDGE, GLASS = "#dde8f0", "#e08a2e", "#52606d", "#7d8b99"
PLUS, MINUS = "#c0392b", "#2c5fa8"

_VTK_TYPES = {8: 12, 6: 13, 4: 10}  # hexahedron, wedge, tetrahedron
_LIFT = 3e-4  # of plates and lines off the surface, relative to the diagonal: else both flicker
_LABEL_OFFSET = 0.045  # of numbers off their electrodes, relative to the diagonal
_RADII, _AZIMUTHS = 49, 72  # points of an indenter's profile, and copies of it around the axis
_DRAWN_HEIGHT = 1.2  # height of the drawn part of an indenter, relative to its radius


def volume(mesh: Mesh) -> Any:
    """Unstructured grid of a mesh's cells."""
    cells = {_VTK_TYPES[mesh.cells.shape[1]]: mesh.cells}
    return require("pyvista", "view").UnstructuredGrid(cells, mesh.points)


def outside(cells: Any) -> Any:
    """Boundary surface of a grid of cells."""
    return cells.extract_surface(algorithm="dataset_surface")


def polygons(corners: Array) -> Any:
    """Surface of polygons (n, k, 3) [m]."""
    points = corners.reshape(-1, 3)
    faces = np.arange(len(points)).reshape(corners.shape[:2])
    return require("pyvista", "view").PolyData.from_regular_faces(points, faces)


def indenter_surface(indenter: Indenter, tip: Array, turned: Array) -> Any:
    """Lower part of an indenter as a surface of revolution or over its footprint, open above.

    Args:
        indenter: indenter with the profile to revolve.
        tip: position of the lowest point, (3,) [m].
        turned: rotation from the upright indenter, (3, 3).
    """
    rim = indenter.rims[1]
    r = np.linspace(0.0, rim, _RADII)
    height = indenter.profile(r)[0]
    r, height = np.append(r, rim), np.append(height, max(height[-1], _DRAWN_HEIGHT * rim))
    azimuth = 2.0 * np.pi / _AZIMUTHS * np.arange(_AZIMUTHS + 1)
    circle = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
    if isinstance(indenter, Footprint):
        corners = indenter.outline @ indenter.rotation.T / rim
        circle = np.concatenate([corners, corners[:1]])
    plane = r[:, None, None] * circle
    rings = np.append(plane, np.broadcast_to(height[:, None, None], plane[..., :1].shape), axis=-1)
    x, y, z = np.moveaxis(rings @ turned.T + tip, -1, 0)[..., None]
    net = outside(require("pyvista", "view").StructuredGrid(x, y, z))
    return net.clean(tolerance=1e-6)  # joins the ends of every ring


def diagonal(mesh: Mesh) -> float:
    """Diagonal of the bounding box [m]."""
    return float(np.linalg.norm(np.ptp(mesh.points, axis=0)))


def electrode_corners(mesh: Mesh, electrode: int) -> tuple[Array, Array]:
    """Corners of an electrode's pieces, (n, 3 or 4, 3) [m], and mean outward normal, (3,)."""
    corners = mesh.contacts.corners[mesh.contacts.electrode == electrode]
    return corners, _unit(area_vectors(corners).sum(axis=0))


def electrode_plate(mesh: Mesh, electrode: int, lift: float = _LIFT) -> Any:
    """Contact surface of an electrode, lifted off the body by a part `lift` of its diagonal."""
    corners, _ = electrode_corners(mesh, electrode)
    return polygons(corners + lift * diagonal(mesh) * _unit(area_vectors(corners))[:, None])


def _unit(vectors: Array) -> Array:
    """Vectors (..., 3) of length one."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: Array = vectors / np.maximum(lengths, np.finfo(float).tiny)
    return unit


def add_solid(plotter: Any, body: Any, color: str, opacity: float, angle: float = 40.0) -> None:
    """Add a translucent surface, with its edges that are sharper than an angle [degree]."""
    plotter.add_mesh(body, color=color, opacity=opacity, smooth_shading=angle < 40.0, **MATT)
    edges = body.extract_feature_edges(feature_angle=angle)
    if edges.n_cells:
        plotter.add_mesh(edges, color=EDGE, line_width=1.5)


def add_electrodes(plotter: Any, mesh: Mesh, drive: Sequence[int] = (), **style: Any) -> None:
    """Add the electrodes, with a drive pair in red and blue."""
    colours = dict(zip(drive, (PLUS, MINUS), strict=False))
    for electrode in range(len(mesh.electrode_facets)):
        colour = colours.get(electrode, METAL)
        plotter.add_mesh(electrode_plate(mesh, electrode), color=colour, **style, **MATT)


def add_numbers(plotter: Any, mesh: Mesh, electrodes: Sequence[int]) -> None:
    """Add the numbers of electrodes, in front of each."""
    places = []
    for electrode in electrodes:
        corners, normal = electrode_corners(mesh, electrode)
        places.append(corners.mean(axis=(0, 1)) + _LABEL_OFFSET * diagonal(mesh) * normal)
    plotter.add_point_labels(
        np.array(places),
        [str(electrode) for electrode in electrodes],
        font_size=22,
        bold=True,
        text_color="black",
        shape_color="white",
        shape_opacity=0.8,
        margin=3,
        show_points=False,
        always_visible=True,
    )


def add_lines(plotter: Any, lines: Any, mesh: Mesh, eye: Array = DIRECTION, **style: Any) -> None:
    """Add lines on the surface, moved towards a viewer in the direction `eye`, if there are any."""
    if lines.n_cells:
        lines = lines.translate(5.0 * _LIFT * diagonal(mesh) * eye, inplace=False)
        plotter.add_mesh(lines, **{"line_width": 1.0, **style})


def lines_of_current(mesh: Mesh, density: Array, plus: int, count: int) -> Any:
    """Streamlines of the current density (cells, 3) from an electrode, of equal current each."""
    cells = volume(mesh)
    cells.cell_data["density"] = density
    lines = cells.cell_data_to_point_data().streamlines_from_source(
        _seeds(mesh, density, plus, count),
        vectors="density",
        integration_direction="forward",
        max_length=20.0 * diagonal(mesh),
        max_steps=8000,
        initial_step_length=0.1,
        max_step_length=0.25,
        min_step_length=1e-3,
        terminal_speed=0.0,
    )
    lines["magnitude"] = np.linalg.norm(lines["density"], axis=1)
    return lines


def _seeds(mesh: Mesh, density: Array, plus: int, count: int) -> Any:
    """Seed points just inside an electrode, distributed by the current through each piece."""
    contacts = mesh.contacts
    mine = np.flatnonzero(contacts.electrode == plus)
    cells = contacts.cell[mine]
    inward = mesh.points[mesh.cells[cells]].mean(axis=1) - contacts.corners[mine].mean(axis=1)
    share = contacts.areas[mine] * np.linalg.norm(density[cells], axis=1)
    steps = (np.arange(count) + 0.5) / count
    chosen = np.searchsorted(np.cumsum(share) / share.sum(), steps)
    corners = contacts.corners[mine[chosen]]
    # Roberts' R2 sequence spreads evenly over a square and, folded, over a triangle.
    shares = np.arange(count)[:, None] * [0.7548776662, 0.5698402910] % 1.0
    if corners.shape[1] == 3:
        shares = np.where(shares.sum(axis=1, keepdims=True) > 1.0, 1.0 - shares, shares)
    sides = corners[:, [1, -1]] - corners[:, :1]
    into = 0.3 * inward[chosen]
    if not len(contacts.facets[plus]):
        into[::2] *= -1.0  # a sheet inside the body conducts to both sides of it
    places = corners[:, 0] + (shares[..., None] * sides).sum(axis=1) + into
    return require("pyvista", "view").PolyData(places)
