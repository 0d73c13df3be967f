"""Meshes, electrodes, indenters and lines of current as pyvista data sets and actors."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.extras import require
from eitskin.geometry.design.patches import area_vectors
from eitskin.geometry.meshing.mesh import Mesh
from eitskin.simulator.scene.indenters import Indenter
from eitskin.simulator.view.render import DIRECTION, MATT

Array = NDArray[np.float64]

GEL, METAL, EDGE, GLASS = "#dde8f0", "#e08a2e", "#52606d", "#7d8b99"
PLUS, MINUS = "#c0392b", "#2c5fa8"

_VTK_TYPES = {8: 12, 6: 13, 4: 10}  # hexahedron, wedge, tetrahedron
_LIFT = 3e-4  # of plates and lines off the surface, relative to the diagonal: else both flicker
_AWAY = 0.045  # of numbers off their electrodes, relative to the diagonal
_RADII, _AZIMUTHS = 49, 73  # points of an indenter's grid
_DRAWN = 1.2  # height of the drawn part of an indenter, relative to its radius


def volume(mesh: Mesh) -> Any:
    """Unstructured grid of a mesh's cells."""
    pv = require("pyvista", "view")
    corners = mesh.cells.shape[1]
    cells = np.column_stack([np.full(len(mesh.cells), corners), mesh.cells])
    types = np.full(len(cells), _VTK_TYPES[corners], dtype=np.uint8)
    return pv.UnstructuredGrid(cells.ravel(), types, mesh.points)


def surface(mesh: Mesh, **point_values: Array) -> Any:
    """Boundary surface of a mesh, with named values (points, ...) at its points."""
    cells = volume(mesh)
    for name, values in point_values.items():
        cells[name] = values
    return cells.extract_surface(algorithm="dataset_surface")


def at_points(mesh: Mesh, values: Array) -> Array:
    """Values (points,) from values of cells (cells,): the mean of the cells around each point."""
    points, corners = mesh.cells.ravel(), mesh.cells.shape[1]
    sums = np.bincount(points, np.repeat(values, corners), len(mesh.points))
    return sums / np.bincount(points, minlength=len(mesh.points))


def revolved(indenter: Indenter, tip: Array, turned: Array) -> Any:
    """Lower part of an indenter as a surface of revolution, open above.

    Args:
        indenter: with the profile to revolve.
        tip: position of the lowest point, (3,) [m].
        turned: rotation from the upright indenter, (3, 3).
    """
    pv = require("pyvista", "view")
    rim = indenter.rims[1]
    r = np.linspace(0.0, rim, _RADII)
    height = indenter.profile(r)[0]
    r, height = np.append(r, rim), np.append(height, max(height[-1], _DRAWN * rim))
    azimuth = np.linspace(0.0, 2.0 * np.pi, _AZIMUTHS)
    upright = np.stack(
        [
            np.outer(r, np.cos(azimuth)),
            np.outer(r, np.sin(azimuth)),
            np.outer(height, np.ones_like(azimuth)),
        ],
        axis=-1,
    )
    x, y, z = np.moveaxis(upright @ turned.T + tip, -1, 0)[..., None]
    net = pv.StructuredGrid(x, y, z).extract_surface(algorithm="dataset_surface")
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


def polygons(corners: Array) -> Any:
    """Surface of polygons (n, k, 3) [m]."""
    count, sides = corners.shape[:2]
    numbers = np.arange(count * sides).reshape(count, sides)
    faces = np.column_stack([np.full(count, sides), numbers])
    return require("pyvista", "view").PolyData(corners.reshape(-1, 3), faces.ravel())


def _unit(vectors: Array) -> Array:
    """Vectors (..., 3) of length one."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: Array = vectors / np.maximum(lengths, np.finfo(float).tiny)
    return unit


def height_inside(mesh: Mesh, electrode: int) -> float | None:
    """Height of an electrode that lies level inside the body [m]; None for all others."""
    heights = electrode_corners(mesh, electrode)[0][..., 2]
    low, high = mesh.points[:, 2].min(), mesh.points[:, 2].max()
    edge = 1e-6 * (high - low)
    inside = np.ptp(heights) < edge and low + edge < heights.mean() < high - edge
    return float(heights.mean()) if inside else None


def add_cells(plotter: Any, mesh: Mesh, line: float, below: float | None = None) -> None:
    """Add the cells' surface, with edges `line` pixels wide, and the electrodes.

    All cells, or those below a height [m].
    """
    edges = {"show_edges": True, "edge_color": EDGE, "line_width": line}
    drawn = surface(mesh)
    if below is not None:
        cells = volume(mesh)
        low = np.flatnonzero(cells.cell_centers().points[:, 2] < below)
        drawn = cells.extract_cells(low).extract_surface(algorithm="dataset_surface")
    plotter.add_mesh(drawn, color=GEL, **edges, **MATT)
    for electrode in range(len(mesh.electrode_facets)):
        plotter.add_mesh(electrode_plate(mesh, electrode), color=METAL, **edges, **MATT)


def add_body(plotter: Any, mesh: Mesh, opacity: float) -> None:
    """Add the body, translucent, with its sharp edges."""
    body = surface(mesh)
    plotter.add_mesh(body, color=GEL, opacity=opacity, **MATT)
    edges = body.extract_feature_edges(feature_angle=40.0)
    if edges.n_cells:
        plotter.add_mesh(edges, color=EDGE, line_width=1.5)


def add_net(plotter: Any, surface: Any, mesh: Mesh, spacing: float) -> None:
    """Add lines of equal x and y of the flat body, `spacing` [m] apart, on the deformed surface.

    The surface holds the flat positions of its points as `flat`.
    """
    for axis in (0, 1):
        low, high = surface["flat"][:, axis].min(), surface["flat"][:, axis].max()
        levels = np.arange(low + spacing, high - 0.01 * spacing, spacing)
        lines = surface.contour(levels, scalars=surface["flat"][:, axis])
        if lines.n_cells:
            lines = towards(DIRECTION, lines, mesh)
            plotter.add_mesh(lines, color=EDGE, line_width=1.0, opacity=0.6)


def add_electrodes(plotter: Any, mesh: Mesh, drive: tuple[int, ...] = ()) -> None:
    """Add the electrodes, with a drive pair in red and blue."""
    colours = dict(zip(drive, (PLUS, MINUS), strict=False))
    for electrode in range(len(mesh.electrode_facets)):
        colour = colours.get(electrode, METAL)
        plotter.add_mesh(electrode_plate(mesh, electrode), color=colour, **MATT)


def add_numbers(plotter: Any, mesh: Mesh, electrodes: Sequence[int]) -> None:
    """Add the numbers of electrodes, in front of each."""
    places = []
    for electrode in electrodes:
        corners, normal = electrode_corners(mesh, electrode)
        places.append(corners.mean(axis=(0, 1)) + _AWAY * diagonal(mesh) * normal)
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


def add_indenter(plotter: Any, body: Any) -> None:
    """Add an indenter, translucent, with its sharp edges."""
    plotter.add_mesh(body, color=GLASS, opacity=0.25, smooth_shading=True, **MATT)
    edges = body.extract_feature_edges(feature_angle=20.0)
    if edges.n_cells:
        plotter.add_mesh(edges, color=EDGE, line_width=1.5)


def add_rim(plotter: Any, mesh: Mesh, electrode: int, direction: Array) -> None:
    """Add the edge of an electrode, for a viewer in `direction`."""
    whole = electrode_plate(mesh, electrode, lift=0.0).clean(tolerance=1e-6)
    rim = whole.extract_feature_edges(feature_edges=False, manifold_edges=False)
    plotter.add_mesh(towards(direction, rim, mesh), color=PLUS, line_width=3.0)


def towards(direction: Array, lines: Any, mesh: Mesh) -> Any:
    """Lines on the surface moved towards a viewer in `direction`, in place on the screen."""
    return lines.translate(5.0 * _LIFT * diagonal(mesh) * direction, inplace=False)


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
    pv = require("pyvista", "view")
    contacts = mesh.contacts
    mine = np.flatnonzero(contacts.electrode == plus)
    cells = contacts.cell[mine]
    inward = mesh.points[mesh.cells[cells]].mean(axis=1) - contacts.corners[mine].mean(axis=1)
    share = contacts.areas[mine] * np.linalg.norm(density[cells], axis=1)
    steps = (np.arange(count) + 0.5) / count
    chosen = np.searchsorted(np.cumsum(share) / share.sum(), steps)
    corners = contacts.corners[mine[chosen]]
    # Roberts' R2 sequence spreads evenly over a square and, folded, over a triangle.
    a, b = (np.arange(count)[:, None] * [0.7548776662, 0.5698402910] % 1.0).T
    if corners.shape[1] == 3:
        outside = a + b > 1.0
        a, b = np.where(outside, 1.0 - a, a), np.where(outside, 1.0 - b, b)
    sides = corners[:, [1, -1]] - corners[:, :1]
    places = corners[:, 0] + a[:, None] * sides[:, 0] + b[:, None] * sides[:, 1]
    into = 0.3 * inward[chosen]
    if not len(contacts.facets[plus]):
        into[::2] *= -1.0  # a sheet inside the body conducts to both sides of it
    return pv.PolyData(places + into)
