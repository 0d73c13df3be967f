"""Connections until their requests are whole: one thread, a deadline, a bounded number."""

import re
import selectors
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

MOST_ARRIVING = 64  # connections whose requests are not whole yet
LARGEST_HEAD = 16384  # bytes
LARGEST_BODY = 4096  # bytes
_CHUNK = 65536  # bytes
_BACKLOG = 128
_NO_DESCRIPTOR = 0.05  # s, until others may have closed one
_END_OF_HEAD = re.compile(rb"\r?\n\r?\n")
_LONGEST_END = 3  # bytes of an end whose last is still to come
_LENGTH = re.compile(
    rb"^content-length[ \t]*:[ \t]*(\d{1,9})[ \t]*\r?$", re.IGNORECASE | re.MULTILINE
)


class Incoming:
    """Bytes of one HTTP request as they come; each byte is looked at once."""

    def __init__(self) -> None:
        """Begin without a byte."""
        self._data = bytearray()
        self._seen = 0  # bytes that hold no end of the head
        self._length = 0  # of the whole request; 0 before the end of its head

    def add(self, data: bytes) -> bytes | None:
        """Head and body of the request, as soon as they are whole; None before that.

        A body is cut where the limit lies, so that its size is known to be too large; a head that
        is too long gives no bytes.
        """
        self._data += data
        if not self._length:
            end = _END_OF_HEAD.search(self._data, self._seen, LARGEST_HEAD)
            if end is None:
                self._seen = max(0, len(self._data) - _LONGEST_END)
                return b"" if len(self._data) >= LARGEST_HEAD else None
            told = _LENGTH.search(self._data, 0, end.end())
            self._length = end.end() + (min(int(told[1]), LARGEST_BODY + 1) if told else 0)
        return bytes(self._data[: self._length]) if len(self._data) >= self._length else None


@dataclass(eq=False, slots=True)
class _Arriving:
    """Connection whose request is not whole yet."""

    connection: socket.socket
    address: str
    until: float
    request: Incoming = field(default_factory=Incoming)


class Arrivals:
    """Reader of requests from a listening socket, in one thread whatever comes.

    A request that is not whole at its deadline is closed, however its bytes trickle. Where too many
    are on their way, the oldest one of the address that has most of them makes room.
    """

    def __init__(
        self,
        listener: socket.socket,
        handle: Callable[[socket.socket, bytes], None],
        deadline: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin to listen.

        Args:
            listener: bound socket, which `close` closes.
            handle: takes a connection and its request, as `Incoming` gives it; returns at once,
                and closes the connection some time.
            deadline: time from a connection to the end of its request [s].
            clock: [s].
        """
        self._listener, self._handle = listener, handle
        self._deadline, self._clock = deadline, clock
        self._waker, self._woken = socket.socketpair()
        self._selector = selectors.DefaultSelector()
        self._arriving: dict[socket.socket, _Arriving] = {}
        self._closed = False
        listener.setblocking(False)
        listener.listen(_BACKLOG)
        for each in (listener, self._woken):
            self._selector.register(each, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._run, name="page arrivals", daemon=True)

    @property
    def count(self) -> int:
        """Number of connections whose requests are not whole yet."""
        return len(self._arriving)

    def start(self) -> None:
        """Read, in a thread."""
        self._thread.start()

    def close(self) -> None:
        """Close the listener and every connection whose request is not whole."""
        self._closed = True
        self._waker.send(b"\0")
        self._thread.join()
        for each in list(self._arriving.values()):
            self._close(each)
        self._selector.close()
        for own in (self._listener, self._waker, self._woken):
            own.close()

    def _run(self) -> None:
        while not self._closed:
            for key, _ in self._selector.select(self._patience()):
                if key.fileobj is self._listener:
                    self._accept()
                elif isinstance(key.data, _Arriving) and key.fileobj in self._arriving:
                    self._read(key.data)
            now = self._clock()
            for late in [each for each in self._arriving.values() if each.until <= now]:
                self._close(late)

    def _patience(self) -> float | None:
        """Time until the next deadline [s]; None where nothing arrives."""
        oldest = next(iter(self._arriving.values()), None)
        return None if oldest is None else max(0.0, oldest.until - self._clock())

    def _accept(self) -> None:
        try:
            connection, address = self._listener.accept()
        except BlockingIOError:
            return
        except OSError:  # no descriptor is left, or the connection has gone already
            if not self._make_room():
                time.sleep(_NO_DESCRIPTOR)
            return
        connection.setblocking(False)
        if len(self._arriving) >= MOST_ARRIVING:
            self._make_room()
        arriving = _Arriving(connection, str(address[0]), self._clock() + self._deadline)
        self._arriving[connection] = arriving
        self._selector.register(connection, selectors.EVENT_READ, arriving)

    def _make_room(self) -> bool:
        """Close one connection; whether there was any."""
        counts = Counter(each.address for each in self._arriving.values())
        if not counts:
            return False
        most = counts.most_common(1)[0][0]
        self._close(next(each for each in self._arriving.values() if each.address == most))
        return True

    def _read(self, arriving: _Arriving) -> None:
        try:
            data = arriving.connection.recv(_CHUNK)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._close(arriving)
            return
        whole = arriving.request.add(data)
        if whole is not None:
            self._forget(arriving)
            arriving.connection.setblocking(True)
            self._handle(arriving.connection, whole)

    def _close(self, arriving: _Arriving) -> None:
        self._forget(arriving)
        with suppress(OSError):
            arriving.connection.close()

    def _forget(self, arriving: _Arriving) -> None:
        del self._arriving[arriving.connection]
        self._selector.unregister(arriving.connection)
