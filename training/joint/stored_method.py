"""Arrays that a joint method is saved as."""

from collections.abc import Mapping
from dataclasses import astuple
from typing import Any
from typing import Protocol as Interface

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import DataError
from eitskin.training.joint.angles.networks import AngleNetworks
from eitskin.training.joint.bend_curve import BendCurve, BendCurvePrior
from eitskin.training.joint.combinations import Combinations
from eitskin.training.joint.place_errors import ErrorScale
from eitskin.training.joint.prior import TouchPrior
from eitskin.training.joint.proposal_model import ProposalNetwork
from eitskin.training.joint.specimen_features import SpecimenFeatures
from eitskin.training.joint.touch_response import TouchResponse
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.method.interface import LearningCurve

Arrays = dict[str, NDArray[np.generic]]

# Arrays of the sensor that the method is adapted to.
OWN = ("calibrated_flat", "own_output", "own_latent")
NETWORKS = ("response", "proposals", "angles")  # parts whose learning curves are kept


class _Stored(Interface):
    """A part that is saved as arrays."""

    def arrays(self) -> Mapping[str, NDArray[np.floating]]: ...


def stored_arrays(fields: Mapping[str, Any]) -> Arrays:
    """Arrays from which `restored_fields` restores the fields of a method, by name."""
    prior: TouchPrior = fields["touch_prior"]
    scalars = [fields["drift"], fields["radius"], prior.separation, *prior.force]
    saved: Arrays = {
        "noise": fields["combinations"].noise,
        "scalars": np.array(scalars),
        "bounds": np.array([prior.low, prior.high]),
        "places": fields["places"],
        "forces": np.array(fields["forces"]),
        "error_scale": np.array(astuple(fields["error_scale"])),
        "own_error_scale": np.array(fields["own_error_scale"]),
        "own_noise_scale": np.array(fields["own_noise_scale"]),
    }
    parts: dict[str, _Stored | None] = {
        "features": fields["features"],
        "response": fields["response"],
        "curves": fields["bend_prior"],
        "proposals": fields["proposals"],
        "combinations": fields["combinations"],
        "angles": fields["angles"],
        "angle_features": fields["angle_features"],
        "usual": fields["usual"],
        "calibrated": fields["calibrated"],
    }
    for name in OWN:
        if fields[name] is not None:
            saved[name] = fields[name]
    for name, curve in fields["learning_curves"].items():
        saved |= {f"{name}.{key}": array for key, array in curve.arrays().items()}
    for name, part in parts.items():
        if part is not None:
            saved |= {f"{name}.{key}": array for key, array in part.arrays().items()}
    return saved


def restored_fields(arrays: Mapping[str, NDArray[np.generic]], spec: InputSpec) -> dict[str, Any]:
    """Fields of the method that the arrays came from, by name."""

    def part(name: str) -> Arrays:
        mine = (key for key in arrays if key.startswith(f"{name}."))
        return {key.removeprefix(f"{name}."): arrays[key] for key in mine}

    drift, radius, separation, *force = arrays["scalars"].astype(float).tolist()
    positive = np.array([drift, radius, separation, force[1], *arrays["noise"].ravel()])
    if not np.all((positive > 0) & (positive < 1e3)):
        raise DataError("expected drift, sizes, forces and noise above zero; train it again")
    low, high = arrays["bounds"].astype(float)
    features, angles, told = part("features"), part("angles"), part("angle_features")
    calibrated, usual = part("calibrated"), part("usual")
    basis = part("combinations").get("basis")  # version 0.1 has none
    one = np.ones(())  # of versions without the scale
    return {
        "features": SpecimenFeatures.from_arrays(features),
        "angle_features": SpecimenFeatures.from_arrays(told) if told else None,
        "response": TouchResponse.from_arrays(part("response")),
        "bend_prior": BendCurvePrior.from_arrays(part("curves")),
        "proposals": ProposalNetwork.from_arrays(part("proposals")),
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
        "learning_curves": {name: LearningCurve.from_arrays(part(name)) for name in NETWORKS},
        "calibrated": BendCurve.from_arrays(calibrated) if calibrated else None,
        "angles": AngleNetworks.from_arrays(angles) if "unit" in angles else None,
        "usual": BendCurvePrior.from_arrays(usual) if usual else None,
        "forces": bool(arrays.get("forces", one)),
        "error_scale": _error_scale(arrays.get("error_scale", one)),
        "own_error_scale": float(arrays.get("own_error_scale", one)),
        "own_noise_scale": float(arrays.get("own_noise_scale", one)),
        **{name: arrays[name].astype(float) if name in arrays else None for name in OWN},
    }


def _error_scale(stored: NDArray[np.generic]) -> ErrorScale:
    """Scale of the standard errors of places; pipelines before had one for all sensors."""
    values = stored.astype(float)
    if values.shape not in {(), (2,)} or not np.all((values >= 0) & (values < 1e6)):
        raise DataError("expected two factors of standard errors from 0 to 1e6; train it again")
    return ErrorScale(*values.tolist()) if values.ndim else ErrorScale(float(values) ** 2)
