"""A demo's datasets: what is in them."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from eitskin.cli.demo.parts import Part, drawn_picture
from eitskin.cli.demo.pictures import raw_frames, states_and_angles, touched_places
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.state import State
from eitskin.training.evaluation.report.drawing import style


def sets(data: Mapping[str, Dataset], recipes: Mapping[str, Recipe]) -> Part:
    """States, angles and places of every set, and frames of the first."""
    first = next(iter(data))
    with style():
        pictures = {
            "states": drawn_picture(
                states_and_angles(data), "Frames per state, and histogram of their bend angles"
            ),
            "places": drawn_picture(touched_places(data), "Places of the touches on the sensor"),
            "frames": drawn_picture(
                raw_frames(data[first], first), "Raw frames: 28 changes of resistance for each"
            ),
        }
    return Part({name: _contents(data[name], recipes[name]) for name in data}, pictures)


def _contents(data: Dataset, recipe: Recipe) -> dict[str, Any]:
    angles = data.bend_angle_deg[data.state != State.IDLE]
    counts = data.touch_count
    return {
        "frames": len(data),
        "seed": data.seed,
        "resolution": recipe.resolution,
        "snr_db": recipe.instrument.snr_db,
        "specimens": len(np.unique(data.specimen)),
        "states": {state.name.lower(): int(np.sum(data.state == state)) for state in State},
        "frames_by_touches": {str(n): int(np.sum(counts == n)) for n in np.unique(counts)},
        "touches": int(counts.sum()),
        "smallest_angle_deg": float(angles.min()) if angles.size else 0.0,
        "largest_angle_deg": float(angles.max()) if angles.size else 0.0,
    }
