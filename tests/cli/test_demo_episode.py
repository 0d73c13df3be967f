"""The film of the demo's report: what is drawn in it is what the episode's rows say."""

import io

import numpy as np
import pytest

from eitskin.cli.demo import pictures
from eitskin.cli.page.drawing import GelShape
from eitskin.geometry import SensorDesign

PLACES = [[40.0, 20.0], [110.0, 40.0]]
DESIGN = SensorDesign.reference()


def row(state, angle, true_angle, found, true, frames=2):
    return {
        "states": [state] * frames,
        "angles_deg": [angle] * frames,
        "true_angle_deg": true_angle,
        "found_mm": [found] * frames,
        "true_touches_mm": true,
    }


ROWS = [
    row("idle", 0.0, 0.0, [], []),
    row("touch", 20.0, 20.0, PLACES, PLACES),
    row("bend", np.nan, 20.0, [], PLACES[:1]),
]


@pytest.mark.slow
def test_the_film_has_every_moment_and_begins_with_the_fullest(monkeypatch):
    image = pytest.importorskip("PIL.Image")
    drawn, draw = [], pictures._draw_moment

    def watched(shape, rows, moment, when):
        drawn.append((moment[0]["states"][moment[1]], round(6 * when)))
        return draw(shape, rows, moment, when)

    monkeypatch.setattr(pictures, "_draw_moment", watched)
    film = image.open(io.BytesIO(pictures.episode_film(ROWS, DESIGN)))
    assert film.n_frames == 6
    states = ["touch", "touch", "bend", "bend", "idle", "idle"]
    assert drawn == list(zip(states, (2, 3, 4, 5, 0, 1), strict=True))


def test_touches_are_drawn_on_the_bent_face():
    axes = pytest.importorskip("matplotlib.figure").Figure().add_subplot(projection="3d")
    shape = GelShape.of(DESIGN)
    pictures.draw_touches(axes, shape, 30.0, PLACES)
    x, y, z = axes.collections[0]._offsets3d
    flat = np.array([(40.0, 20.0, 5.0), (110.0, 40.0, 5.0)])
    assert np.allclose(np.stack([x, y, z], 1), 1e3 * shape.bent(30.0, [], 1e-3 * flat))
    assert not np.allclose(np.stack([x, y, z], 1), flat, atol=1.0)
