"""The newest value of a kind and its readers in other threads, without a queue."""

import threading
from typing import Generic, TypeVar

T = TypeVar("T")


class Latest(Generic[T]):
    """Slot for one value: writers replace the value, readers take each at most once."""

    def __init__(self) -> None:
        """Begin without a value."""
        self._changed = threading.Condition()
        self._value: T | None = None
        self._number = 0
        self._closed = False

    @property
    def number(self) -> int:
        """Number of the newest value, counted from 1; 0 without any."""
        return self._number

    @property
    def value(self) -> T | None:
        """The newest value; None without any."""
        return self._value

    @property
    def is_closed(self) -> bool:
        """Whether no further value will come."""
        return self._closed

    def put(self, value: T) -> None:
        """Replace the value and wake all readers; once closed, do nothing."""
        with self._changed:
            if not self._closed:
                self._value, self._number = value, self._number + 1
                self._changed.notify_all()

    def wait_after(self, number: int, timeout: float | None = None) -> tuple[int, T] | None:
        """Wait for a value after `number`; returns its number and the value.

        Returns None where no value comes within `timeout` [s], or none will come any more.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._number > number, timeout)
            if self._value is None or self._number <= number:
                return None
            return self._number, self._value

    def close(self) -> None:
        """Wake all readers; who has not taken the last value still may."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
