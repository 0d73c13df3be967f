"""Training of the joint method: its model of the sensor, learned from a dataset."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.state import State
from eitskin.errors import DataError
from eitskin.extras import require
from eitskin.geometry.design.surface import Surface
from eitskin.simulator.instrument.drift import DRIFT_TIME
from eitskin.training.joint.bend_curve import BendCurvePrior
from eitskin.training.joint.prior import TouchPrior
from eitskin.training.joint.proposal_model import ProposalNetwork
from eitskin.training.joint.specimen_features import SpecimenFeatures
from eitskin.training.joint.touch_response import InputRanges, TouchResponse
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.method.learning_curve import LearningCurve
from eitskin.training.method.observations import UNKNOWN_AGE
from eitskin.training.method.settings import JointSettings, Progress, silent
from eitskin.training.method.symmetry import Mirror, mirrors
from eitskin.training.method.targets import NOMINAL_RADIUS

if TYPE_CHECKING:
    from eitskin.training.joint.response_training import TouchFrames

Array = NDArray[np.float64]
Made = TypeVar("Made")

PITCH = 0.004  # m, between positions that are tried for touches
FEWEST = 100  # frames of each kind
WEAKEST = 0.1  # least strength of a touch, in units of the noise
HOLD_OUT = 8  # every how many-th specimen is held out to estimate the mismatch


def fit_joint(
    make: Callable[..., Made],
    dataset: Dataset,
    spec: InputSpec,
    settings: JointSettings,
    seed: int = 0,
    progress: Progress = silent,
) -> Made:
    """Learn features, response, bend curves, priors and proposals from all frames of a dataset.

    They make the method: `make`, `JointMethod`, is called with its fields in their order.

    A dataset without any bend gives a method without bend curves, for a sensor that stays flat; one
    without positions of touches a method of the bend alone, and one without forces a method whose
    touches have a strength instead (`_with_strengths`). Raises DataError where it holds too few
    touches of known position, untouched frames at known angles, or idle frames.
    """
    require("torch", "training")

    forces = bool(np.isfinite(dataset.touch_force).any())
    data = _usable(dataset)
    if not _is_touched(data).any():
        return _bend_method(make, data, spec, settings, progress)
    from eitskin.training.joint.proposal_training import SyntheticFrames, fit_proposals

    images = mirrors(spec.design, spec.protocol)
    features = SpecimenFeatures.fit(np.abs(data.reference[np.unique(data.specimen)]), images)
    noise = _noise(data, images)
    touch_prior, ranges = _touch_prior(data, spec), _ranges(data, spec)
    progress("bend curve", 0, 1)
    curves = (
        _curves(data, features, images, noise, settings.drift)
        if data.bend_angle_deg.any()
        else BendCurvePrior.flat(len(features.directions), len(noise))
    )
    progress("bend curve", 1, 1)
    response, response_curve = _response(
        data, features, images, ranges, noise, settings, seed, progress
    )
    proposals, proposals_curve = fit_proposals(
        SyntheticFrames(response, curves, touch_prior, noise), settings.proposals, seed, progress
    )
    radius = float(np.nanmedian(data.touch_radius))
    return make(
        features,
        response,
        curves,
        proposals,
        touch_prior,
        noise,
        settings.drift,
        _places(spec, touch_prior),
        radius,
        spec.outline,
        spec.pixels,
        spec.protocol,
        {"response": response_curve, "proposals": proposals_curve},
        forces=forces,
    )


def _bend_method(
    make: Callable[..., Made],
    data: Dataset,
    spec: InputSpec,
    settings: JointSettings,
    progress: Progress,
) -> Made:
    """Method of a sensor that is never touched: its bend curves, and nothing of touches."""
    images = mirrors(spec.design, spec.protocol)
    features = SpecimenFeatures.fit(np.abs(data.reference[np.unique(data.specimen)]), images)
    noise = _noise(data, images)
    progress("bend curve", 0, 1)
    curves = _curves(data, features, images, noise, settings.drift)
    progress("bend curve", 1, 1)
    return make(
        features,
        TouchResponse.none(len(features.directions), len(noise), spec.outline),
        curves,
        ProposalNetwork((), (), np.zeros(0), np.zeros(0)),
        TouchPrior.anywhere(spec.outline, NOMINAL_RADIUS),
        noise,
        settings.drift,
        np.zeros((0, 2)),
        NOMINAL_RADIUS,
        spec.outline,
        spec.pixels,
        spec.protocol,
        forces=False,
    )


def _usable(dataset: Dataset) -> Dataset:
    """Frames without bad measurements; frames of time series only where there are few others.

    Gels creep in time series, which loosens the relation of force and indentation.
    """
    good = (dataset.status == 0).all(axis=1) & np.isfinite(dataset.bend_angle_deg)
    data = dataset.select(good)
    _, number, length = np.unique(data.episode, return_inverse=True, return_counts=True)
    single = length[number] == 1
    data = data.select(single) if single.mean() > 0.5 else data
    bent = int(np.sum(data.bend_angle_deg != 0))
    if not bent:
        data = _with_flat_references(data)
    if not np.isfinite(data.touch_force).any():
        data = _with_strengths(data)
    found = {"untouched frames with a reference": int(_is_untouched(data).sum())}
    if touched := bool(np.isfinite(data.touch_x).any()):
        kind = "touched frames with known places, forces, radii and a reference"
        found[kind] = int(_is_touched(data).sum())
    if bent or not touched:
        found["bent frames"] = bent
    if min(found.values()) < FEWEST:
        counts = ", ".join(f"{count} {kind}" for kind, count in found.items())
        raise DataError(
            f"the joint method needs at least {FEWEST} frames of each kind that a set has, got "
            f"{counts}; generate more, or train another method with --preset quick"
        )
    return data


def _with_flat_references(data: Dataset) -> Dataset:
    """Frames of a sensor that is never bent: the flat reference where no other is known."""
    known = np.isfinite(data.touch_reference).all(axis=1, keepdims=True)
    flat = data.reference[data.specimen]
    return replace(data, touch_reference=np.where(known, data.touch_reference, flat))


def _with_strengths(data: Dataset) -> Dataset:
    """Frames with the strength of each touch in place of its force, which no frame tells.

    The strength of a frame is the root mean square of its change of log V, less that of the
    untouched frames, over the median of the touched frames. k touches at a time share it as equal
    and independent ones do, each 1 / sqrt k.
    """
    square = np.mean(_log(data.impedance, data.touch_reference) ** 2, axis=1)
    quiet, placed = square[_is_untouched(data)], np.isfinite(data.touch_x)
    noise = float(np.mean(quiet)) if len(quiet) else 0.0
    strength = np.sqrt(np.maximum(square - noise, WEAKEST**2 * noise))
    strength /= np.sqrt(np.maximum(data.touch_count, 1))
    usual = np.nanmedian(np.where(placed.any(axis=1), strength, np.nan)) if placed.any() else 1.0
    force = np.where(placed, strength[:, None] / usual, np.nan)
    return replace(data, touch_force=force.astype(np.float32))


def _is_touched(data: Dataset) -> NDArray[np.bool_]:
    """Whether each frame (n,) has touches of known force and radius and a reference."""
    count = data.touch_count
    known = [np.isfinite(v).sum(axis=1) == count for v in (data.touch_force, data.touch_radius)]
    referenced = np.isfinite(data.touch_reference).all(axis=1)
    touched: NDArray[np.bool_] = (count > 0) & known[0] & known[1] & referenced
    return touched


def _is_untouched(data: Dataset) -> NDArray[np.bool_]:
    """Whether each frame (n,) is untouched and has a reference at the same bend."""
    referenced = np.isfinite(data.touch_reference).all(axis=1)
    untouched: NDArray[np.bool_] = (data.state != State.TOUCH) & referenced
    return untouched


def _noise(data: Dataset, images: Sequence[Mirror]) -> Array:
    """Standard deviation of log V in one frame (C,), averaged over mirror images."""
    quiet = _is_untouched(data)
    change = _log(data.impedance[quiet], data.touch_reference[quiet])
    variance = np.mean(change**2, axis=0) / (1.0 + 1.0 / data.reference_frames)
    floor = 1e-12  # noise-free training sets
    noise: Array = np.sqrt(np.mean([variance[m.order] for m in images], axis=0) + floor)
    return noise


def _touch_prior(data: Dataset, spec: InputSpec) -> TouchPrior:
    """Prior of touches, from the touched frames."""
    columns = (data.touch_x, data.touch_y, data.touch_force)
    x, y, force = (values[_is_touched(data)] for values in columns)
    return TouchPrior.fit(x, y, force, spec.outline, float(np.nanmax(data.touch_radius)))


def _ranges(data: Dataset, spec: InputSpec) -> InputRanges:
    """Ranges of force and angle that the dataset covers."""
    force, angle = data.touch_force, data.bend_angle_deg
    return InputRanges(
        spec.outline,
        (float(np.nanmin(force)), float(np.nanmax(force))),
        (float(angle.min()), float(angle.max())),
    )


def _curves(
    data: Dataset,
    features: SpecimenFeatures,
    images: Sequence[Mirror],
    noise: Array,
    drift: float,
) -> BendCurvePrior:
    """Bend curves, from bent frames and the references of touches on the bent sensor."""
    bent = data.bend_angle_deg != 0
    untouched = bent & (data.state != State.TOUCH)
    referenced = bent & _is_touched(data)
    rows = np.concatenate([np.flatnonzero(untouched), np.flatnonzero(referenced)])
    values = np.concatenate([data.impedance[untouched], data.touch_reference[referenced]])
    specimen = data.specimen[rows].astype(np.int64)
    flat = np.abs(data.reference[specimen]).astype(float)
    change = _log(values, flat)
    own_noise = (
        1.0 if data.source == "simulated" else 2.0
    )  # references of simulated sets are free of noise
    covariance = np.diag(own_noise * noise**2) + drift**2 * UNKNOWN_AGE / DRIFT_TIME
    count = int(specimen.max()) + 1
    return BendCurvePrior.fit(
        np.tile(data.bend_angle_deg[rows].astype(float), len(images)),
        np.concatenate([change[:, m.order] for m in images]),
        np.concatenate([features.apply(flat[:, m.order]) for m in images]),
        np.concatenate([specimen + i * count for i in range(len(images))]),
        covariance,
    )


def _response(
    data: Dataset,
    features: SpecimenFeatures,
    images: Sequence[Mirror],
    ranges: InputRanges,
    noise: Array,
    settings: JointSettings,
    seed: int,
    progress: Progress,
) -> "tuple[TouchResponse, LearningCurve]":
    """Touch response, from touched frames and their mirror images."""
    from eitskin.training.joint.response_training import TouchFrames, fit_response

    touched = data.select(_is_touched(data))
    _, specimen = np.unique(touched.specimen, return_inverse=True)
    flat = np.abs(touched.reference[touched.specimen]).astype(float)
    change = _log(touched.impedance, touched.touch_reference)
    parts = []
    for mirror in images:
        x, y = mirror.places(touched.touch_x.astype(float), touched.touch_y.astype(float))
        parts.append(
            (
                np.stack([x, y, touched.touch_force.astype(float)], axis=-1),
                touched.bend_angle_deg.astype(float),
                features.apply(flat[:, mirror.order]),
                specimen.astype(np.int64),
                change[:, mirror.order],
            )
        )
    frames = TouchFrames(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    variance = (1.0 + 1.0 / data.reference_frames) * noise**2
    rms = float(np.sqrt(np.mean(variance)))
    held_out = frames.specimen % HOLD_OUT == HOLD_OUT - 1
    kept = frames[~held_out] if held_out.any() else frames
    response, curve = fit_response(kept, ranges, rms, settings.response, seed, progress)
    checked = frames[held_out] if held_out.any() else frames
    return replace(response, mismatch=_mismatch(response, checked, variance)), curve


def _mismatch(response: TouchResponse, frames: "TouchFrames", variance: Array) -> float:
    """Relative rms error of the response on `frames`, over all channels.

    The strength of each frame and its q are fitted, because the fit estimates forces and allows for
    q.
    """
    squares = size = 0.0
    for i in range(min(len(frames.change), 2000)):
        touches = frames.touches[i][np.isfinite(frames.touches[i][:, 0])]
        modelled = response.of(frames.features[i])(touches, float(frames.angle_deg[i]))
        specimen = response.of(frames.features[i])
        shapes = specimen.latent_changes(touches, float(frames.angle_deg[i]))
        columns = np.concatenate([modelled.sum(axis=0)[None], shapes])
        metric = np.diag(np.append(0.0, np.ones(len(shapes)))) * np.mean(variance)
        fitted = np.linalg.solve(columns @ columns.T + metric, columns @ frames.change[i])
        squares += float(np.sum((frames.change[i] - fitted @ columns) ** 2 - variance))
        size += float(np.sum((fitted[0] * modelled) ** 2))
    return float(np.sqrt(max(squares / size, 1e-6)))


def _places(spec: InputSpec, touch_prior: TouchPrior) -> Array:
    """Grid of candidate positions on the sensor, within the prior's bounds (n, 2) [m]."""
    axes = [
        np.linspace(low, high, max(2, round((high - low) / PITCH) + 1))
        for low, high in zip(touch_prior.low[:2], touch_prior.high[:2], strict=True)
    ]
    places = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    outline = spec.design.outline
    return places if isinstance(outline, Surface) else places[outline.contains(places)]


def _log(values: NDArray[np.generic], reference: NDArray[np.generic]) -> Array:
    """log |V / ref|."""
    change: Array = np.log(np.abs(values) / np.abs(reference)).astype(float)
    return change
