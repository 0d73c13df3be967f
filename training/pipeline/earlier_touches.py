"""Touches of an earlier frame, which may go on where a later one shows none on its own."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from eitskin.training.method.observations import relative_difference
from eitskin.training.pipeline.held_touch import MAX_HELD_FRAMES
from eitskin.training.pipeline.references import Voltages

LINGERING, MOST_REST = 4.0, 2.0
"""Twice the log odds against a touch that was there, from which it has gone, and the most that it
may leave unexplained, in variances."""
EXPLAINED = 0.5
"""Most that may be left besides noise where the sensor has bent since, over what the touch
explains: bends are known roughly."""
SHOWN, LEAST_SHARE = 2.5, 0.2
"""Standard errors of its share, and the least one, from which a touch that is weaker than it was
has not gone."""
LEAST_BEND = 25.0  # square of a change by a bend that may hide touches, in variances


def _no_directions() -> NDArray[np.float64]:
    return np.zeros((0, 0))


@dataclass
class EarlierTouches:
    """Touches of the latest touched frame.

    Attributes:
        hidden: whether they are there in the latest frame, though a bend hides them.
        undecided: latest frames of a bent sensor that do not settle whether they are there.
    """

    hidden: bool = False
    undecided: int = 0
    _forces: NDArray[np.float64] = field(default_factory=_no_directions)
    _bends: NDArray[np.float64] = field(default_factory=_no_directions)
    _anchor: Voltages = field(default_factory=lambda: np.zeros(0, np.complex128))
    _odds: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def renew(self, voltages: Voltages, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Take the k touches of a frame (measurements,) [ohm], by `Method.motions`.

        Returns the directions (3 k, measurements) without those of bends.
        """
        motions, self._bends = np.split(directions, [3 * (len(directions) // 3)])
        self._forces, self._anchor = motions[2 * len(motions) // 3 :], voltages
        self._odds, self.hidden, self.undecided = np.zeros(len(self._forces)), False, 0
        return motions

    def linger(self, voltages: Voltages, reference: Voltages, variance: float) -> bool:
        """Whether one may touch yet in an untouched frame, as far as noise of a variance shows.

        The frame and its dynamic reference are (measurements,) [ohm].
        """
        if self.hidden or self.undecided:
            return True
        if not len(self._forces):
            return False
        change = relative_difference(voltages, reference)
        good = np.isfinite(change)
        share, size, rest = self._weigh(change[good], self._forces[:, good])
        noise = np.count_nonzero(good) * variance
        most = np.full(len(share), MOST_REST * noise)
        if len(self._bends) and np.all(rest >= most):
            # Directions that bends change as well are no evidence of a touch.
            bends = self._bends[:, good]
            both = np.vstack([change[good], self._forces[:, good]])
            both -= np.linalg.lstsq(bends.T, both.T)[0].T @ bends
            share, size, rest = self._weigh(both[0], both[1:])
            most = np.maximum(most, noise + EXPLAINED * share**2 * size)
        self._odds = np.minimum(self._odds + (2.0 * share - 1.0) * size / variance, 0.0)
        least_share = np.maximum(SHOWN * np.sqrt(variance / size), LEAST_SHARE)
        lingers = (self._odds > -LINGERING) | (share > least_share)
        lingers &= rest < most
        self._forces, self._odds = self._forces[lingers], self._odds[lingers]
        return bool(lingers.any())

    @staticmethod
    def _weigh(
        change: NDArray[np.float64], along: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Share of each of k touches (k, C) in a change (C,), their squares, and the rest's."""
        size = np.einsum("kc,kc->k", along, along)
        share = along @ change / size
        return share, size, np.sum((change - share[:, None] * along) ** 2, axis=1)

    def bent_reference(
        self, voltages: Voltages, touched: bool, variance: float | None
    ) -> Voltages | None:
        """The sensor without them (measurements,) [ohm], as bent as in a frame that hides them.

        The change since the latest frame that had them decides, whatever the bend curve is: a bend
        makes it, and none of the touches. None where it does not, which may leave it undecided.

        Args:
            voltages: voltages of the frame.
            touched: whether the frame before was touched.
            variance: variance of a channel's relative change in one frame; None if unknown.
        """
        held, waited = touched or self.hidden or self.undecided > 0, self.undecided
        self.hidden, self.undecided = False, 0
        if not (held and len(self._bends)) or variance is None:
            return None
        change, variance = relative_difference(voltages, self._anchor), 2.0 * variance
        good = np.isfinite(change)
        both, bends = np.vstack([change[good], self._forces[:, good]]), self._bends[:, good]
        shares = np.linalg.lstsq(bends.T, both.T)[0].T
        bent = shares[0] @ bends
        rest, *along = both - shares @ bends
        size = np.einsum("kc,kc->k", along, along)
        stays = size + 2.0 * np.array(along) @ rest  # twice the log odds, in variances
        if bent @ bent < LEAST_BEND * variance:
            return None
        if rest @ rest > MOST_REST * len(rest) * variance or np.any(stays < LINGERING * variance):
            if waited < MAX_HELD_FRAMES and np.any(stays > -LINGERING * variance):
                self.undecided = waited + 1
            return None
        released = self._anchor * (1.0 - self._forces.sum(axis=0))
        self.hidden, self._anchor = True, voltages
        reference: Voltages = released * (1.0 + shares[0] @ self._bends)
        return reference
