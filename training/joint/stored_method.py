"""Arrays that a joint method is saved as: those of each part, and numbers of the whole."""

from collections.abc import Mapping
from dataclasses import astuple, fields
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import DataError
from eitskin.training.joint.adaptation import ErrorScale
from eitskin.training.joint.bend_curve import BendCurve, BendCurvePrior
from eitskin.training.joint.combinations import Combinations, SpecimenFeatures
from eitskin.training.joint.networks import AngleNetworks, ProposalNetwork
from eitskin.training.joint.prior import TouchPrior
from eitskin.training.joint.touch_response import InputRanges, TouchResponse
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.method.interface import LearningCurve

Arrays = dict[str, NDArray[np.generic]]
Part = TypeVar("Part")

PARTS: dict[str, tuple[str, type]] = {
    "features": ("features", SpecimenFeatures),
    "response": ("response", TouchResponse),
    "bend_prior": ("curves", BendCurvePrior),
    "proposals": ("proposals", ProposalNetwork),
    "angles": ("angles", AngleNetworks),
    "angle_features": ("angle_features", SpecimenFeatures),
    "usual": ("usual", BendCurvePrior),
    "calibrated": ("calibrated", BendCurve),
}
"""Prefix of the arrays, and class, of the parts of a method, by the names of its fields."""
OWN = ("calibrated_flat", "own_output", "own_latent")  # of the sensor that it is adapted to
NETWORKS = ("response", "proposals", "angles")  # parts whose learning curves are kept
NAMES = {"effects": "own", "latent_output": "hidden_output"}  # of arrays, by those of fields
LAYERS = {"weights": "weight", "biases": "bias"}  # prefixes of the arrays of layers
SINGLE = ("weights", "biases", "output", "latent_output")  # saved in single precision


def part_arrays(part: Any) -> Arrays:
    """Arrays from which `restored_part` restores a part: those of its fields, by name."""
    arrays: Arrays = {}
    for name in _field_names(type(part)):
        value, kind = getattr(part, name), np.float32 if name in SINGLE else np.float64
        if name in LAYERS:
            arrays |= {f"{LAYERS[name]}{i}": each.astype(kind) for i, each in enumerate(value)}
        elif name == "ranges":
            arrays["ranges"] = np.array(astuple(value))
        elif value is not None:
            arrays[NAMES.get(name, name)] = np.asarray(value, dtype=kind)
    if "mismatch" in arrays:
        arrays["scale"] = np.array([part.scale, arrays.pop("mismatch")])
    return arrays


def restored_part(kind: type[Part], arrays: Mapping[str, NDArray[np.generic]]) -> Part:
    """The part, of a class, that the arrays came from; raises KeyError where one is missing."""
    values: dict[str, Any] = {}
    for name in _field_names(kind):
        if name in LAYERS:
            count = sum(key.startswith(LAYERS[name]) for key in arrays)
            values[name] = tuple(arrays[f"{LAYERS[name]}{i}"].astype(float) for i in range(count))
        elif name == "angle_deg":
            values[name] = tuple(arrays[name].astype(float).tolist())
        elif name == "ranges":
            values[name] = InputRanges(*map(tuple, arrays[name].astype(float).tolist()))
        elif name == "mismatch":
            values["scale"], values[name] = arrays["scale"].astype(float).tolist()
        elif name == "spread" and name not in arrays:  # of older pipelines
            values[name] = np.ones(len(arrays["mean"]) - 1)
        else:
            values[name] = arrays[NAMES.get(name, name)].astype(float)
    return kind(**values)


def _field_names(kind: Any) -> list[str]:
    return [each.name for each in fields(kind) if each.init]


def stored_arrays(method: Any) -> Arrays:
    """Arrays from which `restored_fields` restores the fields of a method, by name."""
    prior: TouchPrior = method.touch_prior
    saved: Arrays = {
        "noise": method.combinations.noise,
        "scalars": np.array([method.drift, method.radius, prior.separation, *prior.force]),
        "bounds": np.array([prior.low, prior.high]),
        "error_scale": np.array(astuple(method.error_scale)),
    }
    for name in ("places", "forces", "own_error_scale", "own_noise_scale", *OWN):
        if getattr(method, name) is not None:
            saved[name] = np.asarray(getattr(method, name))
    parts = {prefix: getattr(method, name) for name, (prefix, _) in PARTS.items()}
    arrays = {prefix: part_arrays(part) for prefix, part in parts.items() if part is not None}
    if method.combinations.basis is not None:
        arrays["combinations"] = {"basis": method.combinations.basis}
    for name, curve in method.learning_curves.items():
        arrays[name] = arrays.get(name, {}) | curve.arrays()
    return saved | {
        f"{name}.{key}": array for name in arrays for key, array in arrays[name].items()
    }


def restored_fields(arrays: Mapping[str, NDArray[np.generic]], spec: InputSpec) -> dict[str, Any]:
    """Fields of the method that the arrays came from, by name."""
    groups: dict[str, Arrays] = {}
    for key, array in arrays.items():
        name, _, rest = key.partition(".")
        groups.setdefault(name, {})[rest] = array
    drift, radius, separation, *force = arrays["scalars"].astype(float).tolist()
    positive = np.array([drift, radius, separation, force[1], *arrays["noise"].ravel()])
    if not np.all((positive > 0) & (positive < 1e3)):
        raise DataError("expected drift, sizes, forces and noise above zero; train it again")
    low, high = arrays["bounds"].astype(float)
    basis = groups.get("combinations", {}).get("basis")  # version 0.1 has none
    one = np.ones(())  # of versions without the scale
    histories = {name: LearningCurve.from_arrays(groups.get(name, {})) for name in NETWORKS}
    kept = {name for name in groups if "angles" != name or "unit" in groups[name]}
    return {
        **{
            name: restored_part(kind, groups[prefix]) if prefix in kept else None
            for name, (prefix, kind) in PARTS.items()
        },
        **{name: arrays[name].astype(float) if name in arrays else None for name in OWN},
        "touch_prior": TouchPrior(separation, (force[0], force[1]), low, high),
        "combinations": Combinations(
            arrays["noise"].astype(float), None if basis is None else basis.astype(float)
        ),
        "drift": drift,
        "places": arrays["places"].astype(float),
        "radius": radius,
        "size": spec.outline,
        "shape": spec.pixels,
        "protocol": spec.protocol,
        "learning_curves": histories,
        "forces": bool(arrays.get("forces", one)),
        "error_scale": _error_scale(arrays.get("error_scale", one)),
        "own_error_scale": float(arrays.get("own_error_scale", one)),
        "own_noise_scale": float(arrays.get("own_noise_scale", one)),
    }


def _error_scale(stored: NDArray[np.generic]) -> ErrorScale:
    """Scale of the standard errors of places; pipelines before had one for all sensors."""
    values = stored.astype(float)
    if values.shape not in {(), (2,)} or not np.all((values >= 0) & (values < 1e6)):
        raise DataError("expected two factors of standard errors from 0 to 1e6; train it again")
    return ErrorScale(*values.tolist()) if values.ndim else ErrorScale(float(values) ** 2)
