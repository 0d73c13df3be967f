"""Training of the joint method: its model of the sensor, learned from a dataset.

Networks are trained by `touch_training` and `angle_training`, which import torch.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from eitskin.datasets.store.dataset import Dataset
from eitskin.errors import DataError
from eitskin.geometry.design.surface import Surface
from eitskin.simulator.instrument.drift import DRIFT_TIME
from eitskin.threads import one_torch_thread
from eitskin.training.joint.bend_curve import BendCurvePrior
from eitskin.training.joint.clamp_curves import usual_curves
from eitskin.training.joint.combinations import Combinations, SpecimenFeatures
from eitskin.training.joint.mirrored_frames import (
    MirroredFrames,
    frame_noise,
    is_touched,
    is_untouched,
    log_ratio,
)
from eitskin.training.joint.networks import AngleNetworks, ProposalNetwork
from eitskin.training.joint.specimen_model import estimate_angle
from eitskin.training.joint.touch_response import (
    LOG_STRENGTH_STD,
    InputRanges,
    TouchPrior,
    TouchResponse,
)
from eitskin.training.method.input_spec import InputSpec, mirrors
from eitskin.training.method.interface import LearningCurve
from eitskin.training.method.observations import UNKNOWN_AGE
from eitskin.training.method.settings import JointSettings, Progress, silent
from eitskin.training.method.targets import NOMINAL_RADIUS

Array = NDArray[np.float64]
Made = TypeVar("Made")

PITCH = 0.004  # m, between positions that are tried for touches
MIN_FRAMES = 100  # frames of each kind
WEAKEST = 0.1  # least strength of a touch, in units of the noise
TOUCHED_FRAMES = 4000
"""Touched frames from which the proposals are trained for all of their epochs; with fewer, the
response limits the fit."""
MIN_PROPOSALS = 0.25
"""Share of the epochs that the proposals are trained for at least."""
HOLD_OUT = 8  # every how many-th specimen is held out, to show how far errors are larger there
CHECK_FRAMES = 500  # frames of these, by which standard errors of places are scaled
MIN_SPECIMENS = 100  # from which on networks of the angle are tried
MISMATCH_FRAMES = 2000  # of specimens held out, by which errors of the response are estimated
MISMATCH_RANGE = (1e-3, 1.0)
COMPARISON_FRAMES = 2000  # frames, by which networks and bend curves are compared


@dataclass(frozen=True, slots=True)
class TrainingRun:
    """Arguments that the training of all parts of a method shares.

    Attributes:
        features: features of specimens, as networks of the angle are reported them.
        combinations: combinations of the measurements.
        settings: settings of the training.
        seed: seed of everything random.
        progress: called with a stage, steps done and steps in all.
    """

    features: SpecimenFeatures
    combinations: Combinations
    settings: JointSettings
    seed: int
    progress: Progress


@one_torch_thread()
def fit_joint(
    make: Callable[..., Made],
    dataset: Dataset,
    spec: InputSpec,
    settings: JointSettings,
    seed: int = 0,
    progress: Progress = silent,
) -> Made:
    """Learn features, response, bend curves, priors and proposals from all frames of a dataset.

    They make the method: `make`, `JointMethod`, is called with its fields by name.

    A dataset without any bend gives a method without bend curves, for a sensor that stays flat; one
    without positions of touches a method of the bend alone, and one without forces a method whose
    touches have a strength instead (`_with_strengths`). Raises DataError where it holds too few
    touches of known position, untouched frames at known angles, or idle frames.
    """
    whole, images = _usable(dataset), mirrors(spec.design, spec.protocol)
    on_plates = _is_on_plates(whole)
    data = whole.select(~on_plates)
    every = SpecimenFeatures.fit(np.abs(data.reference[np.unique(data.specimen)]), images)
    touched = MirroredFrames.from_touched(data, images)
    bent = MirroredFrames.from_bent(whole, images)
    changes = [(each.change, each.variance) for each in (touched, bent) if len(each.change)]
    combinations = Combinations.fit(changes, frame_noise(data, images))
    run = TrainingRun(every, combinations, settings, seed, progress)
    kinds = (~on_plates, on_plates) if on_plates.any() else (~on_plates,)
    parts = [MirroredFrames.from_bent(whole.select(rows), images) for rows in kinds]
    bends, losses = fit_bends(run, bent, parts)
    touches, touch_losses = _fit_touches(run, data, touched, bends["bend_prior"], spec)
    if on_plates.any():
        plates = whole.select(on_plates)
        frames, ranges = MirroredFrames.from_touched(plates, images), _input_ranges(plates, spec)
        touches["other_response"] = _fit_response(run, frames, ranges)[0]
    return make(
        features=every.first(),
        combinations=combinations,
        drift=settings.drift,
        size=spec.outline,
        shape=spec.pixels,
        protocol=spec.protocol,
        learning_curves={**touch_losses, "angles": losses},
        forces=bool(np.isfinite(dataset.touch_force).any()),
        **bends,
        **touches,
    )


def _fit_touches(
    run: TrainingRun,
    data: Dataset,
    touched: MirroredFrames,
    curves: BendCurvePrior,
    spec: InputSpec,
) -> tuple[dict[str, Any], dict[str, LearningCurve]]:
    """Fields of the method that touched frames and their mirror images show, and losses, by name.

    Without such frames the method is one of the bend alone.
    """
    if not len(touched.change):
        features = len(run.features.first().directions)
        fields = {
            "response": TouchResponse.none(features, len(run.combinations), spec.outline),
            "proposals": ProposalNetwork((), (), np.zeros(0), np.zeros(0)),
            "touch_prior": TouchPrior.anywhere(spec.outline, NOMINAL_RADIUS),
            "places": np.zeros((0, 2)),
            "radius": NOMINAL_RADIUS,
        }
        return fields, {}
    from eitskin.training.joint.touch_training import SyntheticFrames, fit_proposals

    rows, images = is_touched(data), len(np.unique(touched.image))
    touches = np.stack([data.touch_x, data.touch_y, data.touch_force], axis=-1)[rows]
    prior = TouchPrior.fit(touches, spec.outline, float(np.nanmax(data.touch_radius)))
    response, response_losses = _fit_response(run, touched, _input_ranges(data, spec))
    share = max(len(touched.change) // images / TOUCHED_FRAMES, MIN_PROPOSALS)
    settings = run.settings.proposals.shorten(min(share, 1.0))
    synthetic = SyntheticFrames(response, curves, prior, run.combinations)
    proposals, losses = fit_proposals(synthetic, settings, run.seed, run.progress)
    fields = {
        "response": response,
        "proposals": proposals,
        "touch_prior": prior,
        "places": _places(spec, prior),
        "radius": float(np.nanmedian(data.touch_radius)),
    }
    return fields, {"response": response_losses, "proposals": losses}


def _input_ranges(data: Dataset, spec: InputSpec) -> InputRanges:
    """Ranges of the forces and angles of a dataset."""
    angle, force = data.bend_angle_deg, data.touch_force
    ranges = (float(np.nanmin(force)), float(np.nanmax(force)))
    return InputRanges(spec.outline, ranges, (float(angle.min()), float(angle.max())))


def _fit_response(
    run: TrainingRun, touched: MirroredFrames, ranges: InputRanges
) -> tuple[TouchResponse, LearningCurve]:
    """Response to touches, whose mismatch is that on specimens held out, and losses."""
    from eitskin.training.joint.touch_training import fit_response

    frames = touched.combine(run.features.first(), run.combinations)
    held_out = frames.specimen % HOLD_OUT == HOLD_OUT - 1
    seen, checked = (frames[~held_out], frames[held_out]) if held_out.any() else (frames, frames)
    response, losses = fit_response(seen, ranges, run.settings.response, run.seed, run.progress)
    return replace(response, mismatch=fit_mismatch(response, checked)), losses


def _is_on_plates(data: Dataset) -> NDArray[np.bool_]:
    """Whether the sensor of each frame (n,) is touched on plates; of none where those are few.

    Plates change the response to touches, which is learned apart. Bends are learned together.
    """
    on_plates = (np.bincount(data.specimen, data.support_gap > 0.0) > 0.0)[data.specimen]
    counts = [
        np.count_nonzero(kind & part)
        for kind in (is_touched(data), is_untouched(data))
        for part in (on_plates, ~on_plates)
    ]
    return on_plates & (min(counts) >= MIN_FRAMES)


def fit_bends(
    run: TrainingRun, bent: MirroredFrames, parts: Sequence[MirroredFrames] = ()
) -> tuple[dict[str, Any], LearningCurve]:
    """Fields of the method that show the bend, by name, and losses of the networks of the angle.

    Learned from bent frames and the references of touches on the bent sensor, if there are any.
    Their `parts` are those of sensors that their clamps alone hold, and of those on plates. Curves
    depend on the first of the features, networks on all of them.
    """
    first, combinations = run.features.first(), run.combinations
    if not len(bent.change):
        flat = BendCurvePrior.flat(len(first.directions), len(combinations))
        return {"bend_prior": flat}, LearningCurve()
    drift = run.settings.drift**2 * UNKNOWN_AGE / DRIFT_TIME
    frames = bent.combine(first, combinations, drift)
    run.progress("bend curve", 0, 2)
    curves = BendCurvePrior.fit(frames)
    run.progress("bend curve", 1, 2)
    held, *carried = [each.combine(first, combinations, drift) for each in parts] or [frames]
    usual = usual_curves(held, curves) if len(held.change) else None
    others = [each for each in carried if len(each.change) and each.specimens >= MIN_SPECIMENS]
    other = BendCurvePrior.fit(others[0]) if others else None
    run.progress("bend curve", 2, 2)
    networks, losses = _fit_networks(run, frames, curves)
    features = run.features if networks else None
    fields = {"bend_prior": curves, "usual": usual, "other_usual": other, "angles": networks}
    return fields | {"angle_features": features}, losses


def _fit_networks(
    run: TrainingRun, frames: MirroredFrames, curves: BendCurvePrior
) -> tuple[AngleNetworks | None, LearningCurve]:
    """Networks of the bend angle, where they show it better than the bend curves, and losses.

    They are reported all features, and compared by the likelihood of the angles of specimens that
    they were trained without. The curves were fitted with these, a small advantage.
    """
    if frames.specimens < MIN_SPECIMENS:
        return None, LearningCurve()
    from eitskin.training.joint.angle_training import fit_angles, loss_of_estimates

    settings, features = run.settings.angles, run.features.apply(frames.flat)
    networks, losses = fit_angles(frames, features, curves, settings, run.seed, run.progress)
    few = frames[:: -(-len(frames.change) // COMPARISON_FRAMES)]
    pairs = zip(few.change, few.features, strict=True)
    by_curves = np.array(
        [estimate_angle(curves.predict(p), change, few.noise) for change, p in pairs]
    )
    return networks if losses.validation[-1] < loss_of_estimates(few, by_curves) else None, losses


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
        data = replace(data, touch_reference=data.values_before_touch)  # the flat reference
    if not np.isfinite(data.touch_force).any():
        data = _with_strengths(data)
    usable_counts = {"untouched frames with a reference": int(is_untouched(data).sum())}
    if touched := bool(np.isfinite(data.touch_x).any()):
        kind = "touched frames with known places, forces, radii and a reference"
        usable_counts[kind] = int(is_touched(data).sum())
    if bent or not touched:
        usable_counts["bent frames"] = bent
    if min(usable_counts.values()) < MIN_FRAMES:
        counts = ", ".join(f"{count} {kind}" for kind, count in usable_counts.items())
        raise DataError(
            f"the joint method needs at least {MIN_FRAMES} frames of each kind that a set has, got "
            f"{counts}; generate more, or train another method with --preset quick"
        )
    return data


def _with_strengths(data: Dataset) -> Dataset:
    """Frames with the strength of each touch in place of its force, which no frame shows.

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


def held_out_touches(dataset: Dataset) -> Dataset | None:
    """Some touched frames of the specimens that the response was learned without, if there are any.

    By the rule of `_fit_response`.
    """
    data = _usable(dataset)
    rows = np.flatnonzero(is_touched(data))
    number, on_plates = np.zeros(len(rows), dtype=int), _is_on_plates(data)[rows]
    for part in (on_plates, ~on_plates):
        number[part] = np.unique(data.specimen[rows[part]], return_inverse=True)[1]
    rows = rows[number % HOLD_OUT == HOLD_OUT - 1]
    chosen = np.zeros(len(data), dtype=bool)
    chosen[rows[:: max(1, -(-len(rows) // CHECK_FRAMES))]] = True
    return data.select(chosen) if len(rows) else None


def fit_mismatch(response: TouchResponse, frames: MirroredFrames) -> float:
    """Relative rms error of the response on `frames`, over all measurements: the most likely one.

    The rest of a frame after the response is normal, with the covariance that the fit of touches
    gives it: noise, the strength and q of the specimen, and errors of the measurements,
    independent and in proportion to the changes by each touch.
    """
    frames = frames[:: -(-len(frames.change) // MISMATCH_FRAMES)]
    combinations, (count, channels) = frames.combinations, frames.change.shape
    rest, sure = np.empty((count, channels)), np.empty((count, channels, channels))
    errors = np.empty_like(sure)
    for i in range(count):
        touches = frames.touches[i][np.isfinite(frames.touches[i][:, 0])]
        specimen, angle = response.for_specimen(frames.features[i]), float(frames.angle_deg[i])
        modelled = specimen(touches, angle)
        rest[i] = frames.change[i] - modelled.sum(axis=0)
        strength = LOG_STRENGTH_STD * modelled.sum(axis=0)
        effects = np.vstack([strength, specimen.latent_changes(touches, angle)])
        sure[i] = frames.noise + effects.T @ effects
        each = np.sum((modelled @ combinations.back) ** 2, axis=0)
        errors[i] = (combinations.forward.T * each) @ combinations.forward

    def loss(log_mismatch: float) -> float:
        covariance = sure + np.exp(2.0 * log_mismatch) * errors
        whitened = np.linalg.solve(covariance, rest[..., None])[..., 0]
        return float(np.mean(np.sum(rest * whitened, axis=1) + np.linalg.slogdet(covariance)[1]))

    bounds = np.log(MISMATCH_RANGE)
    return float(np.exp(minimize_scalar(loss, bounds=bounds, method="bounded").x))


def _places(spec: InputSpec, touch_prior: TouchPrior) -> Array:
    """Grid of candidate positions on the sensor, within the prior's bounds (n, 2) [m]."""
    axes = [
        np.linspace(low, high, max(2, round((high - low) / PITCH) + 1))
        for low, high in zip(touch_prior.low[:2], touch_prior.high[:2], strict=True)
    ]
    places = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    outline = spec.design.outline
    return places if isinstance(outline, Surface) else places[outline.contains(places)]
