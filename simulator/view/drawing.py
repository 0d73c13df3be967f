"""Drawing by pyvista: panels in PNG files, without a screen, and the actors that they show.

Actors are meshes, electrodes, indenters and lines of current.
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.extras import require
from eitskin.files import atomic_file
from eitskin.geometry.design.patches import area_vectors
from eitskin.geometry.meshing.mesh import Mesh
from eitskin.simulator.scene.indenters import Footprint, Indenter

Array = NDArray[np.float64]
Draw: TypeAlias = Callable[[Any], None]

# Bodies are seen from the front, above, and a little to the right.
DIRECTION = np.array([0.30, -1.0, 0.85]) / np.linalg.norm([0.30, -1.0, 0.85])

# Reflection of light: no face is dark; colours of a scale are hardly shaded.
MATT = {"ambient": 0.45, "diffuse": 0.6, "specular": 0.0}
TRUE = {"ambient": 0.75, "diffuse": 0.3, "specular": 0.0}

# Sizes in pixels: width of a picture, least and largest height of a panel's drawing, title above
# and colour scale or margin below the drawing.
_WIDTH = {1: 1200, 2: 1800}
_LEAST, _MOST = 240, 560
_TITLE, _LEGEND, _PLAIN = 48, 96, 14
_MARGIN = 1.1

GEL, METAL, EDGE, GLASS = "#dde8f0", "#e08a2e", "#52606d", "#7d8b99"
PLUS, MINUS = "#c0392b", "#2c5fa8"

_VTK_TYPES = {8: 12, 6: 13, 4: 10}  # hexahedron, wedge, tetrahedron
_LIFT = 3e-4  # of plates and lines off the surface, relative to the diagonal: else both flicker
_LABEL_OFFSET = 0.045  # of numbers off their electrodes, relative to the diagonal
_RADII, _AZIMUTHS = 49, 72  # points of an indenter's profile, and copies of it around the axis
_DRAWN_HEIGHT = 1.2  # height of the drawn part of an indenter, relative to its radius


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """Panel of a picture: a drawing with its title and camera.

    Attributes:
        title: title above the drawing.
        points: points that the camera has to show, (n, 3) [m].
        draw: function that adds actors to a pyvista plotter.
        legend: whether `draw` adds a colour scale, for which room is left.
        direction: unit vector from the body to the viewer.
    """

    title: str
    points: Array
    draw: Draw
    legend: bool = False
    direction: Array = field(default_factory=DIRECTION.copy)

    @property
    def axes(self) -> tuple[Array, Array]:
        """Unit vectors to the right and upwards on the screen, (3,) each."""
        right = np.cross([0.0, 0.0, 1.0], self.direction)
        right /= np.linalg.norm(right)
        return right, np.cross(self.direction, right)

    @property
    def rim(self) -> int:
        """Height of title and colour scale [pixels]."""
        return _TITLE + (_LEGEND if self.legend else _PLAIN)

    def height(self, width: int) -> int:
        """Height of a panel of this width [pixels]."""
        across, up = (np.ptp(self.points @ axis) for axis in self.axes)
        return int(np.clip(width * up / across, _LEAST, _MOST)) + self.rim

    def look(self, camera: Any, width: int, height: int) -> None:
        """Set a parallel camera that shows all points between title and colour scale."""
        right, up = self.axes
        x, y, depth = (self.points @ axis for axis in (right, up, self.direction))
        per_pixel = _MARGIN * max(np.ptp(x) / width, np.ptp(y) / (height - self.rim))
        raised = 0.5 * per_pixel * (2 * _TITLE - self.rim)
        middle = [0.5 * (v.min() + v.max()) for v in (x, y, depth)]
        target = middle[0] * right + (middle[1] + raised) * up + middle[2] * self.direction
        camera.SetParallelProjection(True)
        camera.focal_point = target
        camera.position = target + 10.0 * per_pixel * width * self.direction
        camera.up = (0.0, 0.0, 1.0)
        camera.parallel_scale = 0.5 * per_pixel * height


def colour_scale(title: str, **options: Any) -> dict[str, Any]:
    """Arguments of pyvista for a colour scale below a panel.

    Panels need different titles: pyvista draws scales of equal title only once.
    """
    return {
        "title": title + "\n",
        "color": "black",
        "title_font_size": 17,
        "label_font_size": 15,
        "position_x": 0.25,
        "position_y": 0.01,
        "width": 0.5,
        "height": 0.12,
        "n_labels": 5,
        "fill": True,
        "background_color": "white",
        **options,
    }


def require_picture(path: str | Path) -> Any:
    """Module pyvista, after a check that a picture can be drawn to `path`.

    Raises ImportError, naming the extra, where pyvista is missing, and ConfigurationError where
    the file is no PNG file or its folder does not exist.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise ConfigurationError(
            f"expected a PNG file, got {path.name}; name a file such as {path.stem}.png"
        )
    if not path.absolute().parent.is_dir():
        raise ConfigurationError(
            f"cannot write {path}: there is no folder {path.parent}; make it, or name another"
        )
    # Without a display VTK would try X first and complain; EGL needs none.
    if not os.environ.get("DISPLAY"):
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    return require("pyvista", "view")


def render(panels: Sequence[Panel], path: str | Path, columns: int = 1) -> None:
    """Draw the panels, row by row, into the PNG file `path`, atomically.

    Raises ImportError and ConfigurationError like `require_picture`, and ConfigurationError where
    the file cannot be written.
    """
    pv = require_picture(path)
    width = _WIDTH[columns] // columns
    rows = [panels[i : i + columns] for i in range(0, len(panels), columns)]
    heights = [max(panel.height(width) for panel in row) for row in rows]
    with atomic_file(path) as temporary:
        plotter = pv.Plotter(
            off_screen=True,
            shape=(len(rows), columns),
            row_weights=heights,
            window_size=(_WIDTH[columns], sum(heights)),
            border=False,
            lighting="none",
        )
        try:
            plotter.set_background("white")
            plotter.add_light(pv.Light(light_type="headlight", intensity=0.9))
            for i, (row, height) in enumerate(zip(rows, heights, strict=True)):
                for j, panel in enumerate(row):
                    plotter.subplot(i, j)
                    _fill(plotter, panel, width, height)
            plotter.enable_anti_aliasing("ssaa", all_renderers=True)
            plotter.screenshot(str(temporary))
        finally:
            plotter.close()


def _fill(plotter: Any, panel: Panel, width: int, height: int) -> None:
    """Draw one panel into the active part of the plotter."""
    panel.draw(plotter)
    title = plotter.add_text(panel.title, font_size=11, position="upper_left", color="black")
    title.prop.SetBackgroundColor(1.0, 1.0, 1.0)
    title.prop.SetBackgroundOpacity(0.85)
    plotter.enable_depth_peeling(6)
    panel.look(plotter.camera, width, height)
    plotter.renderer.ResetCameraClippingRange()


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
