"""Ring of narrow electrodes all round the rim: approximate bounds of layouts of some of them.

One sheet with electrodes wherever one could be is solved once; that gives the resistances between
every two of them and their derivatives, and so the bound of every layout of some of them, in a
millisecond. It is a guess, because the electrodes that a layout does not use still conduct along
the rim. They are narrow, so that this is little, and what is found with them is judged anew.
"""

import hashlib
import io
import itertools
import math
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.layouts.bound import (
    Sampling,
    judged_discretisation,
    mirrored_places,
    own_mirrors,
    touch_derivatives,
)
from eitskin.benchmarks.layouts.candidates import SIZE, Layout, with_electrodes
from eitskin.files import write_file
from eitskin.geometry.design.electrode import Electrode
from eitskin.geometry.design.outline import Rectangle
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.simulator import Simulator
from eitskin.training.evaluation.cramer_rao import scene_derivatives

Array = NDArray[np.float64]

_VERSION = 1  # of what a file means; raised when the calculation changes
_WIDTH = 0.0015  # of an electrode [m]
_CONTACT = 1e-3  # of 5 mm, as the paper's have it [ohm m2]; narrow ones have the same resistance
_USED_WIDTH = 0.005  # of electrodes of the layouts that are guessed at [m]
_OUTLINE = Rectangle(*SIZE)
_FROM_CORNER = 0.0025  # [m]


@dataclass(frozen=True, slots=True, eq=False)
class Ring:
    """Resistances between any two of n electrodes, and their derivatives at presses of 10 N.

    Attributes:
        arcs: where along the rim the electrodes are, rising (n,) [m].
        resistance: of all m pairs, the untouched sheet [ohm].
        change: derivatives of resistance by x [ohm/m], y [ohm/m], force [ohm/N] and the bend's
            angle [ohm/deg], at all p places (p, 4, m).
        snr_db: of the instrument's white noise below full scale [dB].
    """

    arcs: Array
    resistance: Array
    change: Array
    snr_db: float

    def guess(self, chosen: Sequence[int]) -> float:
        """Approximate 90th percentile of the position bound [m] with some electrodes of the ring.

        From one frame against a reference of one, the angle unknown, as `sheet_bound` has it;
        infinite where they do not determine a press.
        """
        count, (a, b) = len(self.arcs), np.array(list(itertools.combinations(sorted(chosen), 2))).T
        pairs = a * (2 * count - a - 1) // 2 + b - a - 1
        noise = Instrument(self.snr_db).deviation(float(self.resistance[pairs].max()))
        white = self.change[:, :, pairs] / (math.sqrt(2.0) * noise)
        alone = np.linalg.norm(white, axis=2)
        units = white / alone[:, :, None]
        try:
            least = np.linalg.inv(units @ units.transpose(0, 2, 1))
        except np.linalg.LinAlgError:
            return math.inf
        variance = np.diagonal(least, axis1=1, axis2=2)[:, :2] / alone[:, :2] ** 2
        return float(np.percentile(np.sqrt(np.abs(variance).sum(axis=1)), 90))


def solved_ring(folder: Path, pitch: float, sampling: Sampling) -> Ring:
    """Ring with electrodes every `pitch` metres, none over a corner; kept in `folder`.

    Raises PartialError where it cannot be written.
    """
    asked = msgspec.json.encode((_VERSION, pitch, asdict(sampling), _WIDTH), order="sorted")
    path = folder / f"ring-{hashlib.sha256(asked).hexdigest()[:20]}.npz"
    arcs = _arcs(pitch)
    try:
        with np.load(path) as kept:
            return Ring(arcs, kept["resistance"], kept["change"], sampling.snr_db)
    except (OSError, KeyError, ValueError, zipfile.BadZipFile):
        ring = _solved(arcs, sampling)
    content = io.BytesIO()
    np.savez(content, resistance=ring.resistance, change=ring.change)
    write_file(path, content.getvalue())
    return ring


def _arcs(pitch: float) -> Array:
    arcs = pitch * (np.arange(round(_OUTLINE.perimeter / pitch)) + 0.5)
    corners = np.append(_OUTLINE.corners, _OUTLINE.perimeter)
    far: Array = arcs[np.abs(arcs[:, None] - corners).min(axis=1) > _FROM_CORNER - 1e-9]
    return far


def _solved(arcs: Array, sampling: Sampling) -> Ring:
    """Solve the ring in the quarter that its mirrors do not repeat.

    In a mirror derivatives by x or y change their sign, which no bound of a place can tell.
    """
    layout = ring_layout(arcs)
    sim = Simulator(layout.design, judged_discretisation(layout.design, sampling.resolution))
    x, y = sampling.grid(layout.design)
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    mirrors = list(own_mirrors(layout.design))
    images = np.array([mirrored_places(len(x), len(y), *mirror) for mirror, _ in mirrors])
    solved = np.unique(images.min(axis=0))
    untouched = scene_derivatives(sim, Scene())
    found = np.array(
        [
            np.concatenate([each.by_touch[0], each.by_angle[None]]) * each.resistance
            for each in touch_derivatives(sim, untouched, 0.0, places[solved])
        ]
    )
    change = np.empty((len(places), *found.shape[1:]))
    for image, (_, order) in zip(images, mirrors, strict=True):
        change[np.ix_(image[solved], np.arange(4), order)] = found
    return Ring(arcs, untouched.resistance, change, sampling.snr_db)


def ring_layout(arcs: Array) -> Layout:
    """Layout of narrow electrodes at arc lengths of the rim (n,) [m]."""
    places = np.round(_OUTLINE.at(arcs), 12) + 0.0
    contact = _CONTACT * _WIDTH / _USED_WIDTH
    electrodes = [Electrode(x, y, _WIDTH, contact_impedance=contact) for x, y in places.tolist()]
    return with_electrodes("ring", electrodes)
