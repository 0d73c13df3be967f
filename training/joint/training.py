"""Learning the joint method's model of the sensor from a dataset."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.state import State
from eitskin.errors import DataError
from eitskin.extras import require
from eitskin.geometry.design.surface import Surface
from eitskin.simulator.instrument.drift import DRIFT_TIME
from eitskin.training.joint.bend_curve import BendCurves
from eitskin.training.joint.method import JointMethod
from eitskin.training.joint.objective import Habits
from eitskin.training.joint.specimen_features import SpecimenFeatures
from eitskin.training.joint.symmetry import Mirror, mirrors
from eitskin.training.joint.touch_response import Ranges, TouchResponse
from eitskin.training.method.input_spec import Layout
from eitskin.training.method.learning_curve import History
from eitskin.training.method.observations import UNKNOWN_AGE
from eitskin.training.method.settings import JointSettings, Progress, silent

if TYPE_CHECKING:
    from eitskin.training.joint.response_training import TouchFrames

Array = NDArray[np.float64]

PITCH = 0.004  # m, between places that are tried for touches
UNSEEN = 8  # every how many-th specimen is kept to measure the mismatch with


def fit_joint(
    dataset: Dataset,
    layout: Layout,
    settings: JointSettings,
    seed: int = 0,
    progress: Progress = silent,
) -> JointMethod:
    """Learn from all frames of `dataset`.

    Raises DataError where it holds too little: touches of known place and force, untouched frames
    at known angles, and idle frames.
    """
    require("torch", "training")
    from eitskin.training.joint.proposal_training import Model, fit_proposals

    data = _usable(dataset)
    images = mirrors(layout.design, layout.protocol)
    features = SpecimenFeatures.fit(np.abs(data.reference[np.unique(data.specimen)]), images)
    noise = _noise(data, images)
    habits, ranges = _habits(data, layout), _ranges(data, layout)
    progress("bend curve", 0, 1)
    curves = _curves(data, features, images, noise, settings.drift)
    progress("bend curve", 1, 1)
    response, response_history = _response(
        data, features, images, ranges, noise, settings, seed, progress
    )
    proposals, proposals_history = fit_proposals(
        Model(response, curves, habits, noise), settings.proposals, seed, progress
    )
    radius = float(np.nanmedian(data.touch_radius))
    return JointMethod(
        features,
        response,
        curves,
        proposals,
        habits,
        noise,
        settings.drift,
        _places(layout, habits),
        radius,
        layout.outline,
        layout.pixels,
        layout.protocol,
        {"response": response_history, "proposals": proposals_history},
    )


def _usable(dataset: Dataset) -> Dataset:
    """Frames without bad measurements, and of time series only where there are few others.

    In time series gels creep: forces then say less about dents.
    """
    good = (dataset.status == 0).all(axis=1) & np.isfinite(dataset.bend_angle_deg)
    data = dataset.select(good)
    _, number, length = np.unique(data.episode, return_inverse=True, return_counts=True)
    single = length[number] == 1
    data = data.select(single) if single.mean() > 0.5 else data
    found = {
        "touched frames with known places, forces and radii": int(_placed(data).sum()),
        "bent frames": int(np.sum(data.bend_angle_deg != 0)),
        "untouched frames with a reference": int(_quiet(data).sum()),
    }
    if min(found.values()) < 100:
        said = ", ".join(f"{count} {what}" for what, count in found.items())
        raise DataError(
            f"the joint method needs at least 100 frames of each kind, got {said}; generate more, "
            "or train the paper's method"
        )
    return data


def _placed(data: Dataset) -> NDArray[np.bool_]:
    count = data.touch_count
    known = [np.isfinite(v).sum(axis=1) == count for v in (data.touch_force, data.touch_radius)]
    referenced = np.isfinite(data.touch_reference).all(axis=1)
    placed: NDArray[np.bool_] = (count > 0) & known[0] & known[1] & referenced
    return placed


def _quiet(data: Dataset) -> NDArray[np.bool_]:
    referenced = np.isfinite(data.touch_reference).all(axis=1)
    quiet: NDArray[np.bool_] = (data.state != State.TOUCH) & referenced
    return quiet


def _noise(data: Dataset, images: Sequence[Mirror]) -> Array:
    """Standard deviation of log V in one frame (C,); mirror images have the same."""
    quiet = _quiet(data)
    change = _log(data.impedance[quiet], data.touch_reference[quiet])
    variance = np.mean(change**2, axis=0) / (1.0 + 1.0 / data.reference_frames)
    floor = 1e-12  # noise-free training sets
    noise: Array = np.sqrt(np.mean([variance[m.order] for m in images], axis=0) + floor)
    return noise


def _habits(data: Dataset, layout: Layout) -> Habits:
    x, y, force = (
        values[_placed(data)] for values in (data.touch_x, data.touch_y, data.touch_force)
    )
    length, width = layout.outline
    low = [max(0.0, np.nanmin(x) - 0.003), max(0.0, np.nanmin(y) - 0.003), 0.3 * np.nanmin(force)]
    high = [
        min(length, np.nanmax(x) + 0.003),
        min(width, np.nanmax(y) + 0.003),
        1.3 * np.nanmax(force),
    ]
    apart = [
        np.hypot(x[:, i] - x[:, j], y[:, i] - y[:, j]) for i in range(x.shape[1]) for j in range(i)
    ]
    distances = np.concatenate(apart)
    distances = distances[np.isfinite(distances)]
    separation = (
        float(distances.min()) if len(distances) else 2 * float(np.nanmax(data.touch_radius))
    )
    mean = float(np.nanmean(force))
    # Specimens feel the same force more or less strongly, by a tenth or two.
    deviation = float(np.hypot(np.nanstd(force), 0.15 * mean))
    return Habits(
        separation, (mean, deviation), np.array(low, dtype=float), np.array(high, dtype=float)
    )


def _ranges(data: Dataset, layout: Layout) -> Ranges:
    force, angle = data.touch_force, data.bend_angle_deg
    return Ranges(
        layout.outline,
        (float(np.nanmin(force)), float(np.nanmax(force))),
        (float(angle.min()), float(angle.max())),
    )


def _curves(
    data: Dataset,
    features: SpecimenFeatures,
    images: Sequence[Mirror],
    noise: Array,
    drift: float,
) -> BendCurves:
    """From bent frames, and the references of touches on the bent sensor."""
    bent = data.bend_angle_deg != 0
    untouched = bent & (data.state != State.TOUCH)
    referenced = bent & _placed(data)
    rows = np.concatenate([np.flatnonzero(untouched), np.flatnonzero(referenced)])
    values = np.concatenate([data.impedance[untouched], data.touch_reference[referenced]])
    specimen = data.specimen[rows].astype(np.int64)
    flat = np.abs(data.reference[specimen]).astype(float)
    change = _log(values, flat)
    own_noise = 1.0 if data.source == "simulated" else 2.0  # theirs are compared with no noise
    covariance = np.diag(own_noise * noise**2) + drift**2 * UNKNOWN_AGE / DRIFT_TIME
    count = int(specimen.max()) + 1
    return BendCurves.fit(
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
    ranges: Ranges,
    noise: Array,
    settings: JointSettings,
    seed: int,
    progress: Progress,
) -> "tuple[TouchResponse, History]":
    from eitskin.training.joint.response_training import TouchFrames, fit_response

    touched = data.select(_placed(data))
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
    unseen = frames.specimen % UNSEEN == UNSEEN - 1
    kept = frames[~unseen] if unseen.any() else frames
    response, history = fit_response(kept, ranges, rms, settings.response, seed, progress)
    checked = frames[unseen] if unseen.any() else frames
    return replace(response, mismatch=_mismatch(response, checked, variance)), history


def _mismatch(response: TouchResponse, frames: "TouchFrames", variance: Array) -> float:
    """Error of the response over its size, where both are summed over all channels."""
    excess = size = 0.0
    for i in range(min(len(frames.change), 2000)):
        touches = frames.touches[i][np.isfinite(frames.touches[i][:, 0])]
        said = response.of(frames.features[i])(touches, float(frames.angle_deg[i]))
        # A common strength is no error of place, the fit has the forces for it; q it allows for.
        specimen = response.of(frames.features[i])
        shapes = specimen.unseen(touches, float(frames.angle_deg[i]))
        columns = np.concatenate([said.sum(axis=0)[None], shapes])
        metric = np.diag(np.append(0.0, np.ones(len(shapes)))) * np.mean(variance)
        fitted = np.linalg.solve(columns @ columns.T + metric, columns @ frames.change[i])
        excess += float(np.sum((frames.change[i] - fitted @ columns) ** 2 - variance))
        size += float(np.sum((fitted[0] * said) ** 2))
    return float(np.sqrt(max(excess / size, 1e-6)))


def _places(layout: Layout, habits: Habits) -> Array:
    """A grid over where touches were seen, on the sensor (n, 2) [m]."""
    axes = [
        np.linspace(low, high, max(2, round((high - low) / PITCH) + 1))
        for low, high in zip(habits.low[:2], habits.high[:2], strict=True)
    ]
    places = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    outline = layout.design.outline
    return places if isinstance(outline, Surface) else places[outline.contains(places)]


def _log(values: NDArray[np.generic], reference: NDArray[np.generic]) -> Array:
    """log |V / ref|."""
    change: Array = np.log(np.abs(values) / np.abs(reference)).astype(float)
    return change
