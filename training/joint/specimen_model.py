"""Model of one specimen: its response, bend curve, possible faults and touch candidates."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from eitskin.training.joint.angles.estimate import (
    AngleEstimate,
    mixed,
    mixture_moments,
    robust_angle,
)
from eitskin.training.joint.angles.networks import (
    FAR_DEG,
    NEAR_DEG,
    AngleNetworks,
    blended,
)
from eitskin.training.joint.angles.posterior import posterior_angle
from eitskin.training.joint.angles.usual import LOG_ODDS
from eitskin.training.joint.bend_curve import BEYOND_DEG, BendCurve
from eitskin.training.joint.combinations import CombinedChange
from eitskin.training.joint.fit.channel_faults import FAULT_THRESHOLD, PossibleFaults
from eitskin.training.joint.fit.touch_search import TouchCandidates
from eitskin.training.joint.touch_response import SpecimenResponse, TouchResponse

Array = NDArray[np.float64]

CONTRADICTION = 3.0  # standard errors between angles that contradict each other
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
        usual: bend curve, should the specimen bend as usual; None where nothing is usual or the
            curve is known.
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
        usual: BendCurve | None = None,
        told: Array | None = None,
    ) -> None:
        """Take the parts of the model; candidates follow when they are asked for.

        `told` are the features of the specimen that networks are told; `features` when omitted.
        """
        self.usual = usual
        self.features, self.response, self.curve = features, response, curve
        self._told = features if told is None else told
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

    def angle_by_networks(self, combined: CombinedChange) -> tuple[float, float]:
        """Angle of an untouched frame and its standard error [deg] by the networks alone.

        Raises ValueError where there are none.
        """
        if self._networks is None:
            raise ValueError("expected networks of the angle, got a specimen without")
        drift = math.sqrt(combined.drift)
        return self._networks.estimate(combined.change, self._told, drift)

    @property
    def has_networks(self) -> bool:
        """Whether networks estimate the angle of this specimen."""
        return self._networks is not None

    def _angle(self, combined: CombinedChange) -> AngleEstimate:
        """Angle of a sensor that bends as usual or in any other way, by the evidence for each."""
        if self.usual is None:
            return self._angle_of_any(combined)
        usual = robust_angle(self.usual, combined, self.faults)
        # Densities of the same measurements are compared; faults have the price of being found.
        fewer = combined.without(usual.left_out) if usual.faults else combined
        price = 0.5 * FAULT_THRESHOLD * len(usual.faults)
        found = mixed(self._angle_of_any(fewer), usual, LOG_ODDS - price)
        return self._angle_of_any(combined) if usual.faults and found.usual < 0.5 else found

    def _angle_of_any(self, combined: CombinedChange) -> AngleEstimate:
        """Angle by the curve, and by the networks where all measurements are good.

        Where the curve leaves out a measurement that the networks take for the bend of some clamp,
        nothing tells which of both is right.
        """
        found = robust_angle(self.curve, combined, self.faults)
        if not self.has_networks:
            return posterior_angle(self.curve, combined, found)
        if not combined.good.all():
            return found
        by_networks = self.angle_by_networks(combined)
        by_curve = (found.angle_deg, found.deviation_deg)
        apart = abs(by_networks[0] - by_curve[0]) / math.hypot(by_networks[1], by_curve[1])
        if found.faults and apart < CONTRADICTION:
            return found
        if found.faults:
            angle, deviation = mixture_moments(by_curve, by_networks, 0.5)
        else:
            angle, deviation = blended(by_curve, by_networks)
        lost = abs(by_networks[0]) < NEAR_DEG and abs(by_curve[0]) >= FAR_DEG
        told = None if found.faults or lost else by_curve
        return replace(found, angle_deg=angle, deviation_deg=deviation, by_curve=told)

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
