"""Pictures of the demo's report: as parts of its file, and what they show."""

import base64
import io
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from eitskin.cli.page.drawing import INSIDE, METAL, GelShape, plan_outline
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import State
from eitskin.extras import require
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.training.evaluation.drawing import (
    BLUE,
    DARK,
    EXTRA,
    GREY,
    ORANGE,
    CaptionedFigure,
    NoFigure,
    draw_sensor,
    new_figure,
)

SHOWN_FRAMES = 6  # of each state
MAX_TOUCHES = 1500  # more would be one grey patch
FILM_FRAMES = 4  # of each step that are shown, evenly spaced
MILLISECONDS = 450  # for which each is shown
FACES = {"idle": "#c9d3dc", "touch": "#f4c9ab", "bend": "#b9d8ee"}
COLOURS = {"idle": GREY, "touch": ORANGE, "bend": BLUE}
_UNQUOTED_CHARACTERS = (
    " !$()*+,-./:;=?@[]^_`{|}~"  # what an address within quotation marks may hold as it is
)

# Words as text instead of outlines of glyphs, and the same bytes each time.
_PLAIN = {"svg.hashsalt": "eitskin", "svg.fonttype": "none"}

Row = Mapping[str, Any]
Places = Sequence[Sequence[float]]


@dataclass(frozen=True, slots=True)
class Picture:
    """Picture of the report: texts for those who see it and those who do not, and the file.

    Attributes:
        alt: short text for readers who do not see the picture.
        caption: full text: content and how it was made.
        source: the file itself as an address.
        width: width where there is room [inch].
    """

    alt: str
    caption: str
    source: str
    width: float

    @classmethod
    def from_webp(cls, alt: str, caption: str, image: bytes, width: float) -> "Picture":
        """Picture of a WebP file."""
        source = f"data:image/webp;base64,{base64.b64encode(image).decode()}"
        return cls(alt, caption, source, width)


def as_pictures(**drawn: tuple[CaptionedFigure | NoFigure, str]) -> dict[str, Picture]:
    """Figures and their alternative texts as pictures; figures that could not be are left out."""
    pictures = {}
    for name, (each, alt) in drawn.items():
        if isinstance(each, CaptionedFigure):  # as text, which is shorter than base64
            source = f"data:image/svg+xml,{quote(_svg(each.figure), safe=_UNQUOTED_CHARACTERS)}"
            pictures[name] = Picture(alt, each.caption, source, each.figure.get_figwidth())
    return pictures


def _svg(figure: Any) -> bytes:
    """SVG file of a figure; equal figures give equal bytes."""
    file = io.BytesIO()
    with require("matplotlib", EXTRA).rc_context(_PLAIN):
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    return file.getvalue()


def render_picture(render: Callable[[Path], None], alt: str, caption: str, width: float) -> Picture:
    """Picture that `render` writes as a PNG, as a WebP file a seventh as large."""
    file = io.BytesIO()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        render(path)
        _image(path).save(file, "WEBP", quality=85, method=6)
    return Picture.from_webp(alt, caption, file.getvalue(), width)


def _image(file: Any) -> Any:
    return require("PIL.Image", EXTRA).open(file).convert("RGB")


def touch_positions(data: Dataset, name: str) -> CaptionedFigure:
    """Positions of all touches of a dataset, over the sensor."""
    figure = new_figure(7.0, 3.4)
    axes = figure.subplots()
    if data.design is not None:
        draw_sensor(axes, data.design)
    count = data.touch_count
    positions = 1e3 * np.stack([data.touch_x, data.touch_y], axis=2)
    for touches, colour, label in ((count == 1, ORANGE, "one"), (count > 1, BLUE, "several")):
        x, y = positions[touches][np.isfinite(positions[touches][:, :, 0])].T[:, :MAX_TOUCHES]
        look = {"s": 7, "color": colour, "alpha": 0.55, "linewidths": 0, "rasterized": True}
        axes.scatter(x, y, label=f"{label} at once", **look)
    axes.set(xlabel="x [mm]", ylabel="y [mm]")
    figure.legend(loc="outside upper center", ncols=2, markerscale=2.5)
    return CaptionedFigure(
        figure,
        f"Positions of the touches in {name}: {int(count.sum())} in {int(np.sum(count > 0))} "
        f"frames, at most {MAX_TOUCHES} of either kind shown. Grey: the sensor's outline and "
        "electrodes.",
    )


def raw_frames(data: Dataset, name: str) -> CaptionedFigure:
    """Some measured frames of each state: change of every resistance from the flat sensor's."""
    figure = new_figure(9.0, 5.2)
    panels = figure.subplots(3, 1, sharex=True)
    change = (np.abs(data.impedance) - np.abs(data.reference[data.specimen])).astype(float)
    for axes, state in zip(panels, State, strict=True):
        flat_or_bend = (data.state == State.BEND) | ~(np.abs(data.bend_angle_deg) > 0)
        rows = np.flatnonzero((data.state == state) & flat_or_bend)[:SHOWN_FRAMES]
        look = {"alpha": 0.8, "linewidth": 1.1, "marker": "o", "markersize": 2.5}
        axes.plot(change[rows].T, color=COLOURS[state.name.lower()], **look)
        axes.axhline(0.0, color=DARK, linewidth=0.8, zorder=0)
        axes.set_ylabel(f"{state.name.lower()} [ohm]")
    labels = data.protocol.labels if data.protocol else ()
    panels[-1].set_xticks(range(len(labels)), labels, rotation=90, fontsize=8)
    panels[-1].set_xlabel("pair of electrodes")
    flat = np.abs(data.reference[0])
    return CaptionedFigure(
        figure,
        f"The first {SHOWN_FRAMES} frames of each state in {name}, touches on the flat sensor, "
        "noise included: change of every resistance from that of the flat, untouched sensor, which "
        f"is {flat.min():.0f} to {flat.max():.0f} ohm. The three scales differ.",
    )


def episode_film(rows: Sequence[Row], design: SensorDesign) -> bytes:
    """Moving picture (WebP) of the rows of `run_episode`.

    It begins with the moment of most touches, which is what paper shows.
    """
    shape = GelShape.from_design(design)
    moments = [
        (row, int(k))
        for row in rows
        for k in np.unique(np.linspace(0, len(row["states"]) - 1, FILM_FRAMES).round())
    ]
    fullest = max(range(len(moments)), key=lambda n: len(moments[n][0]["true_touches_mm"]))
    order = [*range(fullest, len(moments)), *range(fullest)]
    images = [_draw_moment(shape, rows, moments[n], n / len(moments)) for n in order]
    file = io.BytesIO()
    how: dict[str, Any] = {"duration": MILLISECONDS, "loop": 0, "quality": 80}
    images[0].save(file, "WEBP", save_all=True, append_images=images[1:], **how)
    return file.getvalue()


def _draw_moment(shape: GelShape, rows: Sequence[Row], moment: tuple[Row, int], when: float) -> Any:
    """Image of a step's frame: the sensor as estimated and as it is, and all angles.

    A line marks the moment `when`, a part of the episode.
    """
    row, k = moment
    figure = require("matplotlib.figure", EXTRA).Figure(figsize=(6.5, 5.8))
    sensor = figure.add_axes((0.0, 0.1, 1.0, 1.12), projection="3d")  # a square as wide
    state, angle = row["states"][k], float(np.nan_to_num(row["angles_deg"][k]))
    _draw_estimate(sensor, shape, state, angle, row["found_mm"][k])
    _draw_truth(sensor, shape, row["true_angle_deg"], row["true_touches_mm"])
    figure.suptitle(
        f"{state}, {round(angle)} deg (true {row['true_angle_deg']:.0f} deg)",
        color=COLOURS.get(state, DARK),
    )
    axes = figure.add_axes((0.1, 0.09, 0.86, 0.27))
    true = np.repeat([row["true_angle_deg"] for row in rows], [len(row["states"]) for row in rows])
    colours = [COLOURS.get(state, DARK) for row in rows for state in row["states"]]
    frames = np.arange(len(true))
    axes.step(frames, true, where="mid", color=DARK, linewidth=1.0)
    axes.scatter(frames, np.concatenate([r["angles_deg"] for r in rows]), s=9, c=colours, zorder=3)
    axes.axvline(when * len(true), color=DARK, alpha=0.35, linewidth=2)
    axes.set(xlabel="frame", ylabel="bend angle [deg]")
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=110)
    return _image(file)


def _draw_estimate(axes: Any, shape: GelShape, state: str, angle: float, places: Places) -> None:
    """The sensor as estimated, bent and dented, with discs where touches are found."""
    body, kinds = shape.body, shape.body.kinds[shape.body.faces[:, 0]]
    points = 1e3 * shape.bend_points(angle, [(1e-3 * x, 1e-3 * y, np.nan) for x, y in places])
    colours = np.where((kinds == METAL) | (kinds == INSIDE), DARK, FACES.get(state, "#ffffff"))
    collection = require("mpl_toolkits.mplot3d.art3d", EXTRA).Poly3DCollection
    faces = points[body.vertices[body.faces]]
    axes.add_collection3d(collection(faces, facecolors=colours, shade=True, zorder=1))
    draw_touches(axes, shape, angle, places, color=ORANGE, s=60, zorder=3)
    length, width = shape.design.outline.length * 1e3, shape.design.outline.width * 1e3
    axes.set(xlim=(0, length), ylim=(0, width), zlim=(-0.3 * length, 0.15 * length))
    axes.set_box_aspect((length, width, 0.45 * length), zoom=0.95)
    axes.computed_zorder = False
    axes.view_init(32.0, -62.0)
    axes.set_axis_off()


def _draw_truth(axes: Any, shape: GelShape, angle: float, places: Places) -> None:
    """Dashed outline of the sensor as it is, with rings where it is touched."""
    corners = plan_outline(shape.design)
    sides = np.linspace(corners, np.roll(corners, -1, axis=0), 20, axis=1).reshape(-1, 2)
    top = np.column_stack([sides, np.full(len(sides), shape.design.thickness)])
    dashed = {"color": DARK, "linewidth": 1.2, "linestyle": "--", "zorder": 2}
    axes.plot(*(1e3 * shape.bend_points(angle, [], top)).T, **dashed)
    draw_touches(axes, shape, angle, places, color="none", edgecolors=DARK, s=130, zorder=4)


def draw_touches(axes: Any, shape: GelShape, angle: float, places: Places, **look: Any) -> None:
    """Marks at places [mm] on the upper face of the bent sensor."""
    if len(places):
        top = [(1e-3 * x, 1e-3 * y, shape.design.thickness) for x, y in places]
        axes.scatter(
            *(1e3 * shape.bend_points(angle, [], np.array(top))).T, depthshade=False, **look
        )
