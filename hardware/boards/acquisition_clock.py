"""Times of a board's clock by the clock of this machine, from the frames that came fastest."""

import math

from eitskin.frame import Frame

DRIFT = 1e-4  # of two clocks, at most; crystals are off by some 5e-5


class AcquisitionClock:
    """When the measurement of each frame began, by the clock of this machine.

    No frame comes before it was measured: the smallest difference between an arrival and the end of
    that measurement by the board's clock counts as the difference of the two clocks. It holds the
    shortest time on the line, which one end alone cannot tell; every result is late by that.
    """

    def __init__(self) -> None:
        """Begin without a frame."""
        self._session: int | None = None
        self._offset, self._board_time, self._arrived = math.inf, -math.inf, 0.0

    def begun(self, frame: Frame, arrived: float) -> float:
        """Time at which a frame's measurement began [s]; NaN where the board tells no duration.

        Args:
            frame: in the order of arrival.
            arrived: when it came, by the clock of this machine [s].
        """
        if not math.isfinite(frame.duration + frame.time):
            return math.nan
        if frame.session != self._session or frame.time < self._board_time:  # another clock
            self._session, self._offset, self._arrived = frame.session, math.inf, arrived
        self._offset += DRIFT * (arrived - self._arrived)  # what was smallest may be so no more
        self._offset = min(self._offset, arrived - (frame.time + frame.duration))
        self._board_time, self._arrived = frame.time, arrived
        return frame.time + self._offset
