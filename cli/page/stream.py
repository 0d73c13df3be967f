"""The newest message and who waits for it: no queue, so nothing is ever late."""

import threading


class Newest:
    """One place for a message; writers replace it, each reader takes the newest it has not had."""

    def __init__(self) -> None:
        """Begin without a message."""
        self._changed = threading.Condition()
        self._message = b""
        self._number = 0
        self._closed = False

    @property
    def number(self) -> int:
        """Of the newest message; they are counted from 1."""
        return self._number

    def put(self, message: bytes) -> None:
        """Replace the message and wake who waits."""
        with self._changed:
            self._message, self._number = message, self._number + 1
            self._changed.notify_all()

    def after(self, number: int, timeout: float | None = None) -> tuple[int, bytes] | None:
        """The newest message and its number, once that is past `number`; None once closed.

        None also where none comes within `timeout` [s].
        """
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._number > number, timeout)
            if self._closed or self._number <= number:
                return None
            return self._number, self._message

    def close(self) -> None:
        """Let everybody who waits go."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
