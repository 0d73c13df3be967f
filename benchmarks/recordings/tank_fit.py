"""Fits of model parameters to the voltages of a water tank."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from eitskin.benchmarks.recordings.tank_data import Tank
from eitskin.geometry.design.electrode import Electrode
from eitskin.geometry.design.outline import Disc
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator.electrical.forward_model import ForwardModel
from eitskin.simulator.electrical.resolution import Discretisation

Array = NDArray[np.float64]
Values = Mapping[str, Array]

# Only sigma h and z sigma show in the voltages: the model has sigma = 1 S/m and this height.
HEIGHT = 0.05
RESOLUTION: Discretisation = ((4,), Grading(finest=2e-4, coarsest=3e-2, growth=1.5))
MOST_STEPS = 8
SETTLED = 1e-4  # of the voltages, relative, that the last step changes

FIRST = "one conductivity, one contact impedance"
FITS = {
    FIRST: ("sheet", "contact"),
    "a contact impedance per electrode": ("sheet", "contacts"),
    "a place per electrode": ("sheet", "contact", "place"),
    "one electrode width": ("sheet", "width"),
    "a constant per channel": ("sheet", "contact", "constant"),
    "width and constants": ("sheet", "width", "constant"),
    "everything": ("sheet", "contacts", "place", "width", "constant"),
}
LIMITS = {
    "sheet": (1e-9, np.inf),
    "contact": (1e-7, 1.0),
    "contacts": (0.0, 1.0),
    "place": (-0.025, 0.025),
    "width": (0.1, 1.4),
    "constant": (-np.inf, np.inf),
}


def tank_model(tank: Tank, values: Values, resolution: Discretisation = RESOLUTION) -> ForwardModel:
    """Forward model of the tank with sigma = 1 S/m; contact impedances are then z sigma [m]."""
    count = len(tank.angles)
    angles = tank.angles + values["place"]
    contacts = np.broadcast_to(values["contacts"] + values["contact"], count)
    width = float(values["width"][0]) * tank.width * tank.radius
    x, y = tank.radius * (1.0 + np.stack([np.cos(angles), np.sin(angles)]))
    electrodes = tuple(
        Electrode(px, py, width, contact)
        for px, py, contact in zip(x.tolist(), y.tolist(), contacts.tolist(), strict=True)
    )
    design = SensorDesign(Disc(tank.radius), HEIGHT, electrodes, encapsulated_thickness=HEIGHT)
    return ForwardModel(design, resolution)


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Fitted parameters, and the voltages of the model.

    Attributes:
        name: what was free.
        unknowns: how many numbers were free.
        values: of everything.
        voltages: modelled, (channels, patterns) [V].
        residual: relative, of all voltages, of those that sense a driven electrode, of the others.
        resolution, model: on which mesh.
    """

    name: str
    unknowns: int
    values: Values
    voltages: Array
    residual: tuple[float, float, float]
    resolution: Discretisation
    model: ForwardModel


def fit(
    tank: Tank,
    name: str,
    values: Values,
    slopes: Values,
    resolution: Discretisation = RESOLUTION,
) -> Fit:
    """Fit the parameters of `FITS[name]` from `values` on, by Gauss-Newton within `LIMITS`."""
    free, measured = FITS[name], flat(tank.voltages)
    model = tank_model(tank, values, resolution)
    voltages, derivatives = _linearised(tank, model, values, slopes)
    for _ in range(MOST_STEPS):
        J = np.concatenate([derivatives[key] for key in free], axis=1)
        x = np.concatenate([values[key] for key in free])
        low, high = (
            np.concatenate([np.full(len(values[key]), LIMITS[key][end]) for key in free]) - x
            for end in (0, 1)
        )
        scale = 1.0 / np.linalg.norm(J, axis=0)
        step = scale * lsq_linear(J * scale, measured - voltages, (low / scale, high / scale)).x
        ends = np.cumsum([len(values[key]) for key in free])[:-1]
        values = {**values, **dict(zip(free, np.split(x + step, ends), strict=True))}
        before = voltages
        model = tank_model(tank, values, resolution)
        voltages, derivatives = _linearised(tank, model, values, slopes)
        if np.linalg.norm(voltages - before) < SETTLED * np.linalg.norm(voltages):
            break
    modelled = voltages.reshape(tank.voltages.shape[::-1]).T
    return Fit(name, len(x), values, modelled, residuals(tank, modelled), resolution, model)


def start(tank: Tank) -> dict[str, Array]:
    """Initial values of all parameters.

    `sheet` is a resistance [kohm], contacts are z sigma [m], `contacts` adds to `contact`, places
    are turned by `place` [rad], `width` is relative to the tank's own, constants are in V.
    """
    count, channels = len(tank.angles), len(tank.voltages)
    return {
        "sheet": np.ones(1),
        "contact": np.full(1, 1e-5),
        "contacts": np.zeros(count),
        "place": np.zeros(count),
        "width": np.ones(1),
        "constant": np.zeros(channels),
    }


def _linearised(
    tank: Tank, model: ForwardModel, values: Values, slopes: Values
) -> tuple[Array, dict[str, Array]]:
    """Modelled voltages (measurements,), and their derivatives by each block of numbers."""
    unit = HEIGHT * tank.amplitudes * tank.protocol.measure(model.impedance()).real
    sheet, patterns = values["sheet"], tank.voltages.shape[1]
    contacts = (
        HEIGHT
        * (sheet * tank.amplitudes)[:, None]
        * np.real(model.contact_sensitivity(tank.protocol))
    )
    constant = np.tile(np.eye(len(tank.voltages)), (patterns, 1))
    return sheet * unit + constant @ values["constant"], {
        "sheet": unit[:, None],
        "contact": contacts.sum(axis=1, keepdims=True),
        "contacts": contacts,
        "place": sheet * slopes["place"],
        "width": sheet * slopes["width"],
        "constant": constant,
    }


def slopes(tank: Tank, resolution: Discretisation = RESOLUTION) -> dict[str, Array]:
    """Derivatives of the voltages by place and width at the tank's own, for unit sheets.

    By central differences. The tank turned by one electrode is the same tank, so the place of one
    electrode stands for all.
    """
    count = len(tank.angles)
    by_place = _slope(tank, "place", 0.01 * np.eye(count)[0], resolution)
    by_width = _slope(tank, "width", np.full(1, 0.1), resolution)
    turned = [np.roll(by_place, (e, e), axis=(0, 1)) for e in range(count)]
    measured = [tank.amplitudes * tank.protocol.measure(Z).real for Z in (*turned, by_width)]
    return {"place": np.stack(measured[:-1], axis=1), "width": measured[-1][:, None]}


def _slope(tank: Tank, name: str, change: Array, resolution: Discretisation) -> Array:
    """Derivative of the impedance of unit sheets by a number, over its value +- `change`."""
    begin = start(tank)
    raised, lowered = (
        tank_model(tank, {**begin, name: begin[name] + sign * change}, resolution).impedance().real
        for sign in (1.0, -1.0)
    )
    slope: Array = HEIGHT * (raised - lowered) / (2.0 * np.abs(change).max())
    return slope


def residuals(tank: Tank, modelled: Array) -> tuple[float, float, float]:
    """Relative residual of all voltages, of those that sense a driven electrode, of the others."""
    every = np.ones_like(tank.driven)
    all_, driven, others = (
        float(
            np.linalg.norm((modelled - tank.voltages)[rows]) / np.linalg.norm(tank.voltages[rows])
        )
        for rows in (every, tank.driven, ~tank.driven)
    )
    return all_, driven, others


def flat(voltages: Array) -> Array:
    """Flattened voltages, channel by channel for each pattern, (measurements,)."""
    return voltages.T.ravel()
