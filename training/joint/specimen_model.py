"""Model of one specimen: its response, bend curve, possible faults and touch candidates."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from eitskin.training.joint.angles.estimate import AngleEstimate, robust_angle
from eitskin.training.joint.angles.networks import AngleNetworks, blended
from eitskin.training.joint.bend_curve import BendCurve
from eitskin.training.joint.channel_faults import PossibleFaults
from eitskin.training.joint.combinations import CombinedChange
from eitskin.training.joint.objective import BEYOND_DEG
from eitskin.training.joint.touch_response import SpecimenResponse, TouchResponse
from eitskin.training.joint.touch_search import TouchCandidates

Array = NDArray[np.float64]

STEP_DEG = 10.0  # of the angles at which touch candidates are kept


class CandidateRows:
    """Response network at every candidate position, the same for all specimens.

    Evaluated once, at the middle force and at steps of the angle over the range learned from.
    """

    def __init__(
        self, response: TouchResponse, places: Array, angle_deg: tuple[float, float]
    ) -> None:
        """Evaluate `response` at `places` (n, 2) [m] between two angles [deg]."""
        self.places, self.force = places, response.ranges.middle_force
        low, high = angle_deg
        steps = range(_step(low - BEYOND_DEG), _step(high + BEYOND_DEG) + 1)
        touches = np.column_stack([places, np.full(len(places), self.force)])
        self.rows: Mapping[int, Array] = {
            step: response.hidden(touches, step * STEP_DEG) for step in steps
        }


class SpecimenModel:
    """The learned model for one specimen.

    Attributes:
        features: of the specimen (P,).
        response: to touches.
        curve: of bending.
        faults: that are considered.
        problems: reasons to doubt the model, in words.
    """

    def __init__(
        self,
        features: Array,
        response: SpecimenResponse,
        curve: BendCurve,
        faults: PossibleFaults,
        problems: tuple[str, ...],
        rows: CandidateRows,
        networks: AngleNetworks | None = None,
    ) -> None:
        """Take the parts of the model; candidates follow when they are asked for."""
        self.features, self.response, self.curve = features, response, curve
        self.faults, self.problems = faults, problems
        self._rows, self._networks = rows, networks
        self._last: tuple[bytes, AngleEstimate] | None = None
        self._candidates: dict[int, TouchCandidates] = {}

    def angle(self, combined: CombinedChange) -> AngleEstimate:
        """Bend angle of an untouched frame.

        The last estimate is kept, because a reference stays the same while a touch lasts.

        Args:
            combined: of the change from the flat sensor.
        """
        key = combined.change.tobytes() + combined.noise.tobytes()
        if self._last is None or self._last[0] != key:
            self._last = (key, self._angle(combined))
        return self._last[1]

    def _angle(self, combined: CombinedChange) -> AngleEstimate:
        """Angle by the curve, and by the networks where all measurements are good."""
        found = robust_angle(self.curve, combined, self.faults)
        if self._networks is None or found.faults or not combined.good.all():
            return found
        by_networks = self._networks.estimate(
            combined.change, self.features, math.sqrt(combined.drift)
        )
        angle, deviation = blended((found.angle_deg, found.deviation_deg), by_networks)
        return replace(found, angle_deg=angle, deviation_deg=deviation)

    def candidates(self, angle_deg: float) -> TouchCandidates:
        """Touch candidates at the step nearest to an angle [deg]."""
        step = _step(angle_deg)
        if step not in self._candidates:
            change = self._rows.rows[step] @ self.response.output.T
            self._candidates[step] = TouchCandidates(self._rows.places, self._rows.force, change)
        return self._candidates[step]


def _step(angle_deg: float) -> int:
    """Number of the step nearest to an angle [deg]."""
    return round(angle_deg / STEP_DEG)
