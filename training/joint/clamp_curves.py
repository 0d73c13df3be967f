"""Bend curves of clamps between those of the training set, and of the usual clamp.

A set holds some dozens of clamps, whose bends are solved one by one; networks trained on these
alone learn each exactly. The mean curve of a clamp is a smooth function of its free length, axis,
held faces and stiffness, to which plates that carry the sensor add another, and so it is known for
any other.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator
from scipy.spatial.distance import cdist

from eitskin.training.joint.bend_curve import BendCurvePrior
from eitskin.training.joint.mirrored_frames import MirroredFrames

Array = NDArray[np.float64]

MIN_CLAMPS = 12
"""Known clamps from which on others are drawn; a linear function of four properties has five."""
SAMPLE_COUNT = 4000  # clamps
SMOOTHING = 0.1  # of the spline; errors of clamps left out are equal from 0 on
MIN_SPECIMENS = 100  # that make a clamp usual
MAX_SHARE = 0.9  # of the specimens; beyond that all of them are of one clamp
ROUNDS = 3  # of assigning specimens and learning the curves of those assigned, at most
MIN_GAIN = 2.0
"""Least mean of the log-likelihood ratio of a usual specimen that the usual curves were learned
without. The middle of one normal population gains nothing."""
HOLD_OUT = 5  # every how many-th specimen is held out for it
_DIGITS = 1  # of the coordinates, from -1 to 1, of clamps whose curves are taken together
_FLAT = 1e-3  # least extent of the clamps along any direction of their properties, relative


@dataclass(frozen=True, slots=True, eq=False)
class ClampCurves:
    """Mean bend curves, of the clamps of a training set and of others.

    Attributes:
        own: coefficients of that of each specimen's clamp (S, M, K); zero where it is unknown.
        known: whether the clamp of each specimen is known (S,).
        drawn: coefficients of those of clamps drawn at random (D, M, K).
    """

    own: Array
    known: NDArray[np.bool_]
    drawn: Array

    @classmethod
    def fit(
        cls, frames: MirroredFrames, curves: BendCurvePrior, bends: Array, seed: int
    ) -> "ClampCurves":
        """Learn from all frames whose clamps are known; none counts as known where few differ.

        The mean curve of a clamp is that of its specimens and their mirror images, less what their
        features contribute. A thin-plate spline of the clamp's properties goes through them
        (Duchon 1977). Those drawn follow the clamps of the set by a smoothed bootstrap (Silverman
        and Young 1987), between the least and the largest value of each property. `bends` are the
        coefficients of the curves that are expected of the frames (curves, M, K).
        """
        first = np.unique(frames.specimen, return_index=True)[1]
        is_known = np.asarray(np.isfinite(frames.clamp[first]).all(axis=1))
        places = _coordinates(frames.clamp[first][is_known])
        cells, number = np.unique(places.round(_DIGITS), axis=0, return_inverse=True)
        if len(cells) < MIN_CLAMPS or _extent(places) < _FLAT:
            none = np.zeros((1, *curves.mean.shape[1:]))
            return cls(np.repeat(none, len(is_known), axis=0), np.zeros_like(is_known), none)
        each = _without_features(frames, curves, bends)
        spline = RBFInterpolator(
            _means(places, number.ravel()),
            _means(each[is_known].reshape(len(places), -1), number.ravel()),
            smoothing=SMOOTHING,
            kernel="thin_plate_spline",
            degree=1,
        )
        own = np.zeros_like(each)
        own[is_known] = spline(places).reshape(-1, *each.shape[1:])
        drawn = spline(_sample_smoothly(places, len(cells), np.random.default_rng(seed)))
        return cls(own, is_known, drawn.reshape(SAMPLE_COUNT, *each.shape[1:]))


def _coordinates(clamps: Array) -> Array:
    """Properties of clamps (S, 5), each from -1 to 1; those that do not differ are left out."""
    values = np.column_stack([clamps[:, :3], np.log(clamps[:, 3]), clamps[:, 4:]])
    if not len(values):
        return values
    low, high = values.min(axis=0), values.max(axis=0)
    differ = high - low > _FLAT * np.abs(values).max(axis=0)
    places: Array = (2.0 * (values - low) / np.where(differ, high - low, 1.0) - 1.0)[:, differ]
    return places


def _extent(places: Array) -> float:
    """Least extent of points (n, d) along any direction, relative to the largest."""
    sizes = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    return float(sizes[-1] / sizes[0]) if len(sizes) else 0.0


def _sample_smoothly(places: Array, clamps: int, rng: np.random.Generator) -> Array:
    """Points (`SAMPLE_COUNT`, d) distributed smoothly as others; coordinates of two values stay so.

    By a normal kernel of the width of Scott (1992), which serves for as many different `clamps`.
    """
    several = np.array([len(np.unique(values)) > 2 for values in places.T])
    width = places.std(axis=0) * clamps ** (-1.0 / (4 + places.shape[1])) * several
    drawn = rng.choice(places, SAMPLE_COUNT) + width * rng.standard_normal(
        (SAMPLE_COUNT, places.shape[1])
    )
    inside: Array = np.clip(drawn, places.min(axis=0), places.max(axis=0))
    return inside


def _without_features(frames: MirroredFrames, curves: BendCurvePrior, bends: Array) -> Array:
    """Expected curve of each specimen (S, M, K), less the part that its features explain.

    The mean over its mirror images: clamps are symmetric.
    """
    _, first = np.unique(frames.curve, return_index=True)
    explained = np.tensordot(frames.features[first], curves.mean[1:], axes=1)
    residuals = bends - explained
    means = _means(residuals.reshape(len(residuals), -1), frames.specimen[first])
    return means.reshape(-1, *residuals.shape[1:])


def _means(rows: Array, group: NDArray[np.intp] | NDArray[np.int64]) -> Array:
    """Mean of the rows (n, d) of each group, in the order of their numbers from 0 on."""
    total = np.zeros((int(group.max()) + 1, rows.shape[1]))
    np.add.at(total, group, rows)
    mean: Array = total / np.bincount(group)[:, None]
    return mean


def usual_curves(frames: MirroredFrames, everywhere: BendCurvePrior) -> BendCurvePrior | None:
    """Curves of the largest group of specimens that bend alike; None where there is none.

    The search begins with the closest neighbours that are to be found. Then, in turn, the curves of
    the group are learned, and every specimen belongs to the group whose curves are likelier by
    them than by those of all specimens, `everywhere` (classification EM, Celeux and Govaert 1992).
    """
    count, own = frames.specimens, frames[frames.image == 0]  # mirror images show nothing more
    if count < 2 * MIN_SPECIMENS:
        return None
    likelihood = everywhere.log_likelihood(own)

    def fit_curves(some: NDArray[np.bool_]) -> BendCurvePrior:
        return BendCurvePrior.fit(frames[some[frames.specimen]])

    member = _closest(frames.coordinates())
    for _ in range(ROUNDS):
        gain = fit_curves(member).log_likelihood(own) - likelihood
        before, member = member, gain > -np.log(member.sum() / (count - member.sum()))
        if not MIN_SPECIMENS <= member.sum() <= MAX_SHARE * count:
            return None
        if (member == before).all():
            break
    held_out = member & (np.arange(count) % HOLD_OUT == HOLD_OUT - 1)
    unseen = fit_curves(member & ~held_out).log_likelihood(own) - likelihood
    return fit_curves(member) if unseen[held_out].mean() >= MIN_GAIN else None


def _closest(coordinates: Array) -> NDArray[np.bool_]:
    """Whether each specimen (S,) is of the `MIN_SPECIMENS` that lie closest together."""
    distance = cdist(coordinates, coordinates)
    radius = np.partition(distance, MIN_SPECIMENS - 1, axis=1)[:, MIN_SPECIMENS - 1]
    middle = int(radius.argmin())
    closest: NDArray[np.bool_] = distance[middle] <= radius[middle]
    return closest
