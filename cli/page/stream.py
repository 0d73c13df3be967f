"""The newest message and its readers, without a queue."""

import threading


class LatestMessage:
    """Slot for one message: writers replace the message, readers take it once each."""

    def __init__(self) -> None:
        """Begin without a message."""
        self._changed = threading.Condition()
        self._message = b""
        self._number = 0
        self._closed = False

    @property
    def number(self) -> int:
        """Number of the newest message, counted from 1."""
        return self._number

    def put(self, message: bytes) -> None:
        """Replace the message and wake all readers."""
        with self._changed:
            self._message, self._number = message, self._number + 1
            self._changed.notify_all()

    def after(self, number: int, timeout: float | None = None) -> tuple[int, bytes] | None:
        """Wait for a message after `number`; returns number and message, or None once closed.

        Returns None also where no message comes within `timeout` [s].
        """
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._number > number, timeout)
            if self._closed or self._number <= number:
                return None
            return self._number, self._message

    def close(self) -> None:
        """Wake all readers for the last time."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
