"""Training of all that tells the bend: curves, usual curves, and networks of the angle."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from eitskin.simulator.instrument.session import DRIFT_TIME
from eitskin.training.joint.angles.estimate import estimate_angle
from eitskin.training.joint.angles.networks import AngleNetworks
from eitskin.training.joint.angles.usual import usual_curves
from eitskin.training.joint.bend_curve import BendCurvePrior
from eitskin.training.joint.bent_frames import BentFrames
from eitskin.training.joint.combinations import Combinations
from eitskin.training.joint.mirrored_frames import MirroredFrames
from eitskin.training.joint.specimen_features import SpecimenFeatures
from eitskin.training.method.interface import LearningCurve
from eitskin.training.method.observations import UNKNOWN_AGE
from eitskin.training.method.settings import JointSettings, Progress

Array = NDArray[np.float64]

FEWEST_SPECIMENS = 100  # from which on networks of the angle are tried
COMPARED = 2000  # frames, by which networks and bend curves are compared


@dataclass(frozen=True, slots=True, eq=False)
class LearnedBends:
    """Parts of the joint method that tell the bend.

    Attributes:
        curves: distribution of the bend curves of all specimens.
        usual: distribution of those of the usual clamp, if there is one.
        networks: of the angle, where they tell it better than the curves.
        losses: of the networks.
    """

    curves: BendCurvePrior
    usual: BendCurvePrior | None = None
    networks: AngleNetworks | None = None
    losses: LearningCurve = field(default_factory=LearningCurve)


def fit_bends(
    bent: MirroredFrames,
    features: SpecimenFeatures,
    combinations: Combinations,
    settings: JointSettings,
    seed: int,
    progress: Progress,
) -> LearnedBends:
    """Learn from bent frames and the references of touches on the bent sensor, if there are any.

    Curves depend on the first of the features, networks on all of them.
    """
    first = features.first()
    if not len(bent.change):
        return LearnedBends(BendCurvePrior.flat(len(first.directions), len(combinations)))
    frames = BentFrames(
        combinations.of(bent.change),
        bent.angle_deg,
        first.apply(bent.flat),
        bent.specimen,
        bent.image,
        combinations,
        _noise(bent, combinations, settings.drift),
        bent.clamp,
    )
    progress("bend curve", 0, 2)
    curves = BendCurvePrior.fit(frames)
    progress("bend curve", 1, 2)
    usual = usual_curves(frames, curves)
    progress("bend curve", 2, 2)
    told = features.apply(bent.flat)
    networks, losses = fit_networks(frames, told, curves, settings, seed, progress)
    return LearnedBends(curves, usual, networks, losses)


def _noise(bent: MirroredFrames, combinations: Combinations, drift: float) -> Array:
    """Covariance (K, K) of the noise of one bent frame's change."""
    noise = np.diag(bent.noise * combinations.unit**2)
    shared = drift**2 * UNKNOWN_AGE / DRIFT_TIME
    noise += np.outer(combinations.drift, combinations.drift) * shared
    return noise


def fit_networks(
    frames: BentFrames,
    features: Array,
    curves: BendCurvePrior,
    settings: JointSettings,
    seed: int,
    progress: Progress,
) -> tuple[AngleNetworks | None, LearningCurve]:
    """Networks of the bend angle, where they tell it better than the bend curves.

    They are compared by the likelihood of the angles of specimens that they were trained without;
    the curves were not fitted without these, and are a little the better for it.

    Args:
        frames: n frames of all specimens.
        features: that the networks are told (n, Q).
        curves: distribution of the bend curves.
        settings: of the training.
        seed: of everything random.
        progress: called after every epoch.
    """
    if frames.specimens < FEWEST_SPECIMENS:
        return None, LearningCurve()
    from eitskin.training.joint.angles.training import fit_angles, loss_of_estimates

    networks, losses = fit_angles(frames, features, curves, settings.angles, seed, progress)
    few = frames[:: -(-len(frames.change) // COMPARED)]
    pairs = zip(few.change, few.features, strict=True)
    by_curves = np.array([estimate_angle(curves.of(p), change, few.noise) for change, p in pairs])
    return networks if losses.validation[-1] < loss_of_estimates(few, by_curves) else None, losses
