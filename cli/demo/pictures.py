"""Pictures that only the demo draws: touches, raw frames, and the frame of a real board."""

import base64
import io
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from eitskin.cli.demo.live_episode import COLOURS
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import State
from eitskin.extras import require
from eitskin.training.evaluation.drawing import (
    BLUE,
    DARK,
    EXTRA,
    ORANGE,
    CaptionedFigure,
    NoFigure,
    draw_sensor,
    new_figure,
)

SHOWN_FRAMES = 6  # of each state
MAX_TOUCHES = 1500  # more would be one grey patch
_UNQUOTED = " !$()*+,-./:;=?@[]^_`{|}~"  # what an address within quotation marks may hold as it is

# Words as text instead of outlines of glyphs, and the same bytes each time.
_PLAIN = {"svg.hashsalt": "eitskin", "svg.fonttype": "none"}

Array = NDArray[np.float64]


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
    def of_webp(cls, alt: str, caption: str, image: bytes, width: float) -> "Picture":
        """Picture of a WebP file."""
        source = f"data:image/webp;base64,{base64.b64encode(image).decode()}"
        return cls(alt, caption, source, width)


def as_pictures(**drawn: tuple[CaptionedFigure | NoFigure, str]) -> dict[str, Picture]:
    """Figures and their alternative texts as pictures; figures that could not be are left out."""
    pictures = {}
    for name, (each, alt) in drawn.items():
        if isinstance(each, CaptionedFigure):  # as text, which is shorter than base64
            source = f"data:image/svg+xml,{quote(_svg(each.figure), safe=_UNQUOTED)}"
            pictures[name] = Picture(alt, each.caption, source, each.figure.get_figwidth())
    return pictures


def _svg(figure: Any) -> bytes:
    """SVG file of a figure; equal figures give equal bytes."""
    file = io.BytesIO()
    with require("matplotlib", EXTRA).rc_context(_PLAIN):
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    return file.getvalue()


def rendered(render: Callable[[Path], None], alt: str, caption: str, width: float) -> Picture:
    """Picture that `render` writes as a PNG, as a WebP file a seventh as large."""
    image, file = require("PIL.Image", EXTRA), io.BytesIO()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        render(path)
        image.open(path).convert("RGB").save(file, "WEBP", quality=85, method=6)
    return Picture.of_webp(alt, caption, file.getvalue(), width)


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
