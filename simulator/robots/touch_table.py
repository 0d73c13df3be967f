"""Table of the measurements of one touch, for frames in microseconds."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import NdBSpline, make_interp_spline

from eitskin.geometry.design.outline import Rectangle
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.mechanics import solved_files
from eitskin.simulator.robots.touch_rules import TouchRules
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.scene.touch import AnyIndenter, Touch
from eitskin.simulator.simulator import Simulator

SPACING = 0.0025  # m, at most, between places of the table
FORCES = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 3 / 4, 1.0)  # over the strongest
FEWEST = 4  # places along an axis, for cubic splines
_VERSION = 1  # raise it whenever the table is solved in another way

Array = NDArray[np.float64]


class TouchTable:
    """Changes of the logarithm of all measurements by one touch, over place and force.

    Between the solved touches they are cubic splines. Changes of several touches are not their
    sum: neighbours that both press hard are a third of their signal off it.
    """

    def __init__(self, axes: tuple[Array, Array, Array], changes: Array) -> None:
        """Interpolate changes (x, y, force, values) at x [m], y [m] and forces [N], from 0 N on."""
        knots, coefficients = [], changes
        for axis, nodes in enumerate(axes):
            spline = make_interp_spline(nodes, coefficients, axis=axis)
            knots.append(spline.t)
            coefficients = np.moveaxis(spline.c, 0, axis)  # first, whatever the axis
        self._spline = NdBSpline(tuple(knots), coefficients, 3)

    @classmethod
    def solved(
        cls,
        simulator: Simulator,
        outline: Rectangle,
        indenter: AnyIndenter,
        rules: TouchRules,
        instrument: Instrument | None = None,
        spacing: float = SPACING,
    ) -> "TouchTable":
        """Table within some rules, from the user's folder for caches, or solved now and kept there.

        Solving takes as long as 7,200 scenes do for the reference sensor.
        """
        axes = _axes(outline, rules, spacing)
        flat = _logarithms(simulator, [Scene()], instrument)[0]
        path = solved_files.folder() / solved_files.file_name(
            "touches",
            {
                "version": _VERSION,
                "flat": flat.tolist(),
                "axes": [axis.tolist() for axis in axes],
                "sensor": repr((simulator.design, simulator.mechanics, simulator.touch_model)),
                "indenter": repr(indenter),
            },
        )

        def solve() -> dict[str, NDArray[Any]]:
            places = [Touch(x, y, f, indenter) for x in axes[0] for y in axes[1] for f in axes[2]]
            scenes = [Scene(touches=(touch,)) for touch in places]
            changes = _logarithms(simulator, scenes, instrument) - flat
            return {"changes": changes.reshape(*map(len, axes), len(flat))}

        read, write = partial(solved_files.read, path), partial(solved_files.write, path)
        changes = solved_files.kept(path, read, solve, write)["changes"]
        # Without force nothing changes.
        forces = np.concatenate([[0.0], axes[2]])
        return cls((axes[0], axes[1], forces), np.pad(changes, [(0, 0), (0, 0), (1, 0), (0, 0)]))

    def factors(self, touches: Sequence[Touch]) -> NDArray[np.complex128]:
        """Measurements under each touch over those of the untouched sensor, (touches, values)."""
        points = np.array([(each.x, each.y, each.force) for each in touches]).reshape(-1, 3)
        real, imaginary = np.split(self._spline(points), 2, axis=1)
        return np.asarray(np.exp(real + 1j * imaginary))


def _axes(outline: Rectangle, rules: TouchRules, spacing: float) -> tuple[Array, Array, Array]:
    """Places along x and y [m] and forces [N] at which touches are solved."""

    def along(length: float) -> Array:
        margin = min(rules.margin, length / 3)
        count = int(np.ceil((length - 2.0 * margin) / spacing - 1e-9)) + 1
        return np.linspace(margin, length - margin, max(count, FEWEST))

    return along(outline.length), along(outline.width), rules.most * np.array(FORCES)


def _logarithms(
    simulator: Simulator, scenes: Sequence[Scene], instrument: Instrument | None
) -> Array:
    """Logarithms of all measurements, real parts before imaginary ones, (scenes, values)."""
    solved = simulator.measure_all(scenes, instrument=instrument)
    logarithms = np.log(solved.reshape(len(scenes), -1))
    return np.concatenate([logarithms.real, logarithms.imag], axis=1)
