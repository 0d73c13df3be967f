"""Figure of pictures without training, of frames that the pipeline has not seen."""

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.design.surface import Surface
from eitskin.training.evaluation.evaluate import Evaluation
from eitskin.training.evaluation.report.drawing import CaptionedFigure, NoFigure
from eitskin.training.evaluation.report.picture_panels import PicturePanel, draw_panels
from eitskin.training.reconstruction.reconstructor import Method, Reconstructor

METHODS: tuple[Method, ...] = ("back-projection", "noser", "greit")
PIXELS = 1000


def pictures_by_count(evaluation: Evaluation) -> CaptionedFigure | NoFigure:
    """Pictures by several methods of the first frame with each number of touches."""
    layout = evaluation.pipeline.layout
    if isinstance(layout.design.outline, Surface):
        return NoFigure("pictures are those of sensors with an outline in the plane")
    frames = _first_of_each_count(evaluation)
    if not len(frames):
        return NoFigure("no touched frame has touches of known positions and radii")
    data = evaluation.dataset.select(frames)
    flat = data.reference[data.specimen]
    known = np.isfinite(data.touch_reference).all(axis=1, keepdims=True)
    before = np.where(known, data.touch_reference, flat)
    values = np.where(data.status == 0, data.impedance, np.nan)
    makers = [
        Reconstructor(layout.design, layout.protocol, method, pixels=PIXELS, resolution="coarse")
        for method in METHODS
    ]
    pictures = [maker.images(maker.data(values, before)) for maker in makers]
    panels = [
        PicturePanel(
            f"{maker.method}, {count} touch{'es' * (count > 1)}",
            layout.design,
            maker.grid,
            picture[row],
            _circles(data.touch_x[row], data.touch_y[row], data.touch_radius[row]),
        )
        for row, count in enumerate(data.touch_count.tolist())
        for maker, picture in zip(makers, pictures, strict=True)
    ]
    figure = draw_panels(panels, columns=len(METHODS), common=False)
    return CaptionedFigure(
        figure,
        "Pictures without training: change of conductivity from the untouched sensor at the same "
        "bend, one step of linear reconstruction from the sensor's design. The first frame with "
        "each number of touches, without selection. Dashed: the true touches.",
    )


def _first_of_each_count(evaluation: Evaluation) -> NDArray[np.int64]:
    """First frame with each number of touches of known position and radius, rising."""
    data = evaluation.dataset
    placed = np.isfinite(data.touch_x)
    drawable = placed.any(axis=1) & (np.isfinite(data.touch_radius) | ~placed).all(axis=1)
    chosen = np.flatnonzero(drawable)
    _, first = np.unique(data.touch_count[chosen], return_index=True)
    return chosen[first]


def _circles(
    x: NDArray[np.float32], y: NDArray[np.float32], radius: NDArray[np.float32]
) -> tuple[tuple[float, float, float], ...]:
    return tuple(
        (float(px), float(py), float(r))
        for px, py, r in zip(x, y, radius, strict=True)
        if np.isfinite(px)
    )
