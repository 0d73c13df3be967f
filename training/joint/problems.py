"""Warnings about faulty measurements and frames that the model does not explain, in words."""

import numpy as np
from numpy.typing import NDArray

from eitskin.training.joint.angles.estimate import AngleEstimate
from eitskin.training.joint.fit.model_selection import REPORTED_SIGMA, FrameFit
from eitskin.training.joint.fit.objective import misfit_sigma
from eitskin.training.joint.prior import MOST_TOUCHES

SAME_SPECIMEN = 0.008  # spread of log ratios of two sessions of a sensor; paths err by 0.4 %


def fit_problems(found: FrameFit, bend: AngleEstimate, touches: bool) -> tuple[str, ...]:
    """Warnings about one frame.

    Whether `touches` were learned: else the poor fit of the angle says all there is to say.
    """
    problems = [
        f"{fault.name} and was left out: look at its contact and wire" for fault in found.faults
    ]
    problems += [
        f"{fault.name} since the session began and was left out of the angle: begin a new "
        "session with the flat sensor"
        for fault in bend.faults
    ]
    if bend.misfit_sigma > REPORTED_SIGMA:
        problems.append(
            f"no angle explains this frame ({bend.misfit_sigma:.0f} standard deviations off): do "
            "not rely on it, and begin a new session with the flat sensor"
        )
    if touches and misfit_sigma(found.misfit, found.degrees_of_freedom) >= REPORTED_SIGMA:
        problems.append(
            f"no bend and up to {MOST_TOUCHES} touches explain this frame (misfit "
            f"{found.misfit:.0f}, expected about {found.degrees_of_freedom}): touches of another "
            "kind, a bad contact, or a reference that is out of date; do not rely on its touches"
        )
    return tuple(problems)


def calibration_problems(
    flat: NDArray[np.float64], calibrated: NDArray[np.float64] | None
) -> tuple[str, ...]:
    """Warning for a sensor that is not the calibrated one; empty otherwise.

    Args:
        flat: magnitudes of the flat, untouched sensor (C,) [ohm].
        calibrated: those of the calibrated sensor; None where no sensor was.
    """
    if calibrated is None:
        return ()
    spread = float(np.nanstd(np.log(flat / calibrated)))
    if spread < SAME_SPECIMEN:
        return ()
    return (
        f"the flat sensor differs by {spread:.1%} from the one that this pipeline was calibrated "
        f"for (up to {SAME_SPECIMEN:.1%} are expected): calibrate again, or use the pipeline that "
        "was not calibrated",
    )
