"""Rendering of panels into PNG files, without a screen."""

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
