"""Training of the joint method: its model of the sensor, learned from a dataset."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.errors import DataError
from eitskin.extras import require
from eitskin.geometry.design.surface import Surface
from eitskin.simulator.instrument.drift import DRIFT_TIME
from eitskin.training.joint.angles.estimate import estimate_angle
from eitskin.training.joint.angles.networks import AngleNetworks
from eitskin.training.joint.bend_curve import BendCurvePrior
from eitskin.training.joint.combinations import Combinations
from eitskin.training.joint.mirrored_frames import (
    MirroredFrames,
    is_touched,
    is_untouched,
    log_ratio,
    noise_of,
)
from eitskin.training.joint.prior import TouchPrior
from eitskin.training.joint.proposal_model import ProposalNetwork
from eitskin.training.joint.specimen_features import SpecimenFeatures
from eitskin.training.joint.touch_response import InputRanges, TouchResponse
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.method.learning_curve import LearningCurve
from eitskin.training.method.observations import UNKNOWN_AGE
from eitskin.training.method.settings import JointSettings, Progress, silent
from eitskin.training.method.symmetry import mirrors
from eitskin.training.method.targets import NOMINAL_RADIUS

if TYPE_CHECKING:
    from eitskin.training.joint.response_training import TouchFrames

Array = NDArray[np.float64]
Made = TypeVar("Made")

PITCH = 0.004  # m, between positions that are tried for touches
FEWEST = 100  # frames of each kind
WEAKEST = 0.1  # least strength of a touch, in units of the noise
TOUCHED_FRAMES = 4000
"""Touched frames from which the proposals are trained for all of their epochs; with fewer, the
response limits the fit."""
LEAST_PROPOSALS = 0.25
"""Share of the epochs that the proposals are trained for at least."""
FEWEST_SPECIMENS = 100  # from which on networks of the angle are tried
COMPARED = 2000  # frames, by which networks and bend curves are compared
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
    if not is_touched(data).any():
        return _bend_method(make, data, spec, settings, seed, progress)
    from eitskin.training.joint.proposal_training import SyntheticFrames, fit_proposals

    images = mirrors(spec.design, spec.protocol)
    features = SpecimenFeatures.fit(np.abs(data.reference[np.unique(data.specimen)]), images)
    touched, bent = MirroredFrames.touched(data, images), MirroredFrames.bent(data, images)
    kinds = [(each.change, each.noise) for each in (touched, bent) if len(each.change)]
    combinations = Combinations.fit(kinds, noise_of(data, images))
    touch_prior, ranges = _touch_prior(data, spec), _ranges(data, spec)
    progress("bend curve", 0, 1)
    curves = (
        _curves(bent, features, combinations, settings.drift)
        if len(bent.change)
        else BendCurvePrior.flat(len(features.directions), len(combinations))
    )
    progress("bend curve", 1, 1)
    angles, angles_curve = _angles(bent, features, combinations, curves, settings, seed, progress)
    response, response_curve = _response(
        touched, features, combinations, ranges, settings, seed, progress
    )
    frames = len(touched.change) // len(images)
    proposals, proposals_curve = fit_proposals(
        SyntheticFrames(response, curves, touch_prior, combinations),
        settings.proposals.shortened(min(max(frames / TOUCHED_FRAMES, LEAST_PROPOSALS), 1.0)),
        seed,
        progress,
    )
    radius = float(np.nanmedian(data.touch_radius))
    return make(
        features,
        response,
        curves,
        proposals,
        touch_prior,
        combinations,
        settings.drift,
        _places(spec, touch_prior),
        radius,
        spec.outline,
        spec.pixels,
        spec.protocol,
        {"response": response_curve, "proposals": proposals_curve, "angles": angles_curve},
        angles=angles,
        forces=forces,
    )


def _bend_method(
    make: Callable[..., Made],
    data: Dataset,
    spec: InputSpec,
    settings: JointSettings,
    seed: int,
    progress: Progress,
) -> Made:
    """Method of a sensor that is never touched: its bend curves, and nothing of touches."""
    images = mirrors(spec.design, spec.protocol)
    features = SpecimenFeatures.fit(np.abs(data.reference[np.unique(data.specimen)]), images)
    bent = MirroredFrames.bent(data, images)
    combinations = Combinations.fit([(bent.change, bent.noise)], noise_of(data, images))
    progress("bend curve", 0, 1)
    curves = _curves(bent, features, combinations, settings.drift)
    progress("bend curve", 1, 1)
    angles, angles_curve = _angles(bent, features, combinations, curves, settings, seed, progress)
    return make(
        features,
        TouchResponse.none(len(features.directions), len(combinations), spec.outline),
        curves,
        ProposalNetwork((), (), np.zeros(0), np.zeros(0)),
        TouchPrior.anywhere(spec.outline, NOMINAL_RADIUS),
        combinations,
        settings.drift,
        np.zeros((0, 2)),
        NOMINAL_RADIUS,
        spec.outline,
        spec.pixels,
        spec.protocol,
        {"angles": angles_curve},
        angles=angles,
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
    found = {"untouched frames with a reference": int(is_untouched(data).sum())}
    if touched := bool(np.isfinite(data.touch_x).any()):
        kind = "touched frames with known places, forces, radii and a reference"
        found[kind] = int(is_touched(data).sum())
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
    square = np.mean(log_ratio(data.impedance, data.touch_reference) ** 2, axis=1)
    quiet, placed = square[is_untouched(data)], np.isfinite(data.touch_x)
    noise = float(np.mean(quiet)) if len(quiet) else 0.0
    strength = np.sqrt(np.maximum(square - noise, WEAKEST**2 * noise))
    strength /= np.sqrt(np.maximum(data.touch_count, 1))
    usual = np.nanmedian(np.where(placed.any(axis=1), strength, np.nan)) if placed.any() else 1.0
    force = np.where(placed, strength[:, None] / usual, np.nan)
    return replace(data, touch_force=force.astype(np.float32))


def _touch_prior(data: Dataset, spec: InputSpec) -> TouchPrior:
    """Prior of touches, from the touched frames."""
    columns = (data.touch_x, data.touch_y, data.touch_force)
    x, y, force = (values[is_touched(data)] for values in columns)
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
    bent: MirroredFrames, features: SpecimenFeatures, combinations: Combinations, drift: float
) -> BendCurvePrior:
    """Bend curves, from bent frames and the references of touches on the bent sensor."""
    return BendCurvePrior.fit(
        bent.angle_deg,
        combinations.of(bent.change),
        features.apply(bent.flat),
        bent.specimen + bent.image * (int(bent.specimen.max()) + 1),
        _bend_noise(bent, combinations, drift),
    )


def _bend_noise(bent: MirroredFrames, combinations: Combinations, drift: float) -> Array:
    """Covariance (K, K) of the noise of one bent frame's change."""
    noise = np.diag(bent.noise * combinations.unit**2)
    shared = drift**2 * UNKNOWN_AGE / DRIFT_TIME
    noise += np.outer(combinations.drift, combinations.drift) * shared
    return noise


def _angles(
    bent: MirroredFrames,
    features: SpecimenFeatures,
    combinations: Combinations,
    curves: BendCurvePrior,
    settings: JointSettings,
    seed: int,
    progress: Progress,
) -> tuple[AngleNetworks | None, LearningCurve]:
    """Networks of the bend angle, where they tell it better than the bend curves.

    They are compared by the likelihood of the angles of specimens that they were trained without;
    the curves were not fitted without these, and are a little the better for it.
    """
    if len(np.unique(bent.specimen)) < FEWEST_SPECIMENS:
        return None, LearningCurve()
    from eitskin.training.joint.angles.training import BentFrames, fit_angles, loss_of_estimates

    frames = BentFrames(
        combinations.of(bent.change),
        bent.angle_deg,
        features.apply(bent.flat),
        bent.specimen,
        combinations,
    )
    networks, curve = fit_angles(frames, settings.angles, seed, progress)
    few = frames[:: -(-len(frames.change) // COMPARED)]
    noise = _bend_noise(bent, combinations, settings.drift)
    pairs = zip(few.change, few.features, strict=True)
    by_curves = np.array([estimate_angle(curves.of(p), change, noise) for change, p in pairs])
    return networks if curve.validation[-1] < loss_of_estimates(few, by_curves) else None, curve


def _response(
    touched: MirroredFrames,
    features: SpecimenFeatures,
    combinations: Combinations,
    ranges: InputRanges,
    settings: JointSettings,
    seed: int,
    progress: Progress,
) -> "tuple[TouchResponse, LearningCurve]":
    """Touch response, from touched frames and their mirror images."""
    from eitskin.training.joint.response_training import TouchFrames, fit_response

    frames = TouchFrames(
        touched.touches,
        touched.angle_deg,
        features.apply(touched.flat),
        touched.specimen,
        combinations.of(touched.change),
    )
    variance = touched.noise * combinations.unit**2
    rms = float(np.sqrt(np.mean(variance)))
    held_out = frames.specimen % HOLD_OUT == HOLD_OUT - 1
    kept = frames[~held_out] if held_out.any() else frames
    response, curve = fit_response(kept, ranges, rms, settings.response, seed, progress)
    checked = frames[held_out] if held_out.any() else frames
    return replace(response, mismatch=_mismatch(response, checked, variance, combinations)), curve


def _mismatch(
    response: TouchResponse, frames: "TouchFrames", variance: Array, combinations: Combinations
) -> float:
    """Relative rms error of the response on `frames`, over all measurements.

    The strength of each frame and its q are fitted, because the fit estimates forces and allows for
    q. Independent errors of the measurements, relative to their changes, are to give combinations
    of the errors that are found.
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
        each = combinations.changes(fitted[0] * modelled)
        size += combinations.total_variance(np.sum(each**2, axis=0))
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
