"""Board on a serial port: the host's side of the wire protocol.

No frame is made up: lost and damaged frames are counted, and a silent board is an error.
"""

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from eitskin.errors import ConfigurationError, DeviceError
from eitskin.files import shorten_text
from eitskin.frame import Frame, Status
from eitskin.hardware.boards.board import PortBoard, longest_silence
from eitskin.hardware.boards.port import SerialPort, UnrecoverableError, connector
from eitskin.hardware.protocol import messages
from eitskin.hardware.protocol.packets import (
    PER_PACKET,
    Decoder,
    FrameAssembly,
    FrameData,
    FramePart,
    MessageError,
    PacketDrop,
    encode,
)
from eitskin.protocol import Protocol

REPLY_TIMEOUT = 0.5  # s
TRIES = 3

log = logging.getLogger(__name__)
Answer = TypeVar("Answer", bound=messages.Message)


class SerialBoard(PortBoard[messages.Message]):
    """Board on a serial port; a `Board`.

    Attributes:
        info: identity and settings; replaced when the board restarts.
        events: the last 20 lines of text from the firmware.

    Example:
        >>> from eitskin.hardware import open_board
        >>> board = open_board("serial:/dev/ttyACM0")  # doctest: +SKIP
    """

    info: messages.Info

    def __init__(
        self,
        connect: Callable[[], SerialPort],
        uri: str,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Open the port, and ask for the board's identity and measurement table.

        Args:
            connect: opens a port whose reads return soon; called again by `reconnect`.
            uri: name of the board in messages.
            clock: time that silence is measured by [s].

        Raises DeviceError where the board does not answer as expected.
        """
        self.events: deque[messages.Event] = deque(maxlen=20)
        self._decoder = Decoder()
        self._assembly = FrameAssembly(self._decoder.drops)
        self._malformed, self._latest = "", b""
        self._seq = 0
        self._expected: int | None = None
        self._restarted = self._resuming = False
        super().__init__(connect, uri, clock)
        try:
            self.info = self._handshake()
            self.protocol = self._read_protocol()
        except BaseException:
            self.close()
            raise

    def _drops(self) -> Sequence[Mapping[Any, int]]:
        return (self._decoder.drops,)

    def frames(self, newest: bool = False) -> Iterator[Frame]:
        self._discard_received()
        if not self._resuming:
            self._expected = None
        self._start()
        while True:
            if newest:
                self._discard_old()
            frame = self._next_frame()
            if newest:
                frame = self._newest_pending(frame)
            self._frames += 1
            yield frame

    def reconnect(self) -> None:
        """Close the port and connect again; `frames` then goes on, as `Board` says.

        Frames numbered meanwhile are lost and counted; after a restart their number is unknown.
        """
        self._port.reopen()
        self._decoder.restart()
        self._discard_received()
        new_info = self._handshake()
        self._require_same(new_info)
        self._resuming = new_info.boot_count == self.info.boot_count
        self.info = new_info
        self._reconnections += 1

    def calibrate(self) -> None:
        self._request(messages.Calibrate(), messages.Ack)

    def close(self) -> None:
        if self._port.closed:
            return
        try:
            self._send(messages.Stop(), self._seq + 1)
        except DeviceError:
            pass  # a board that has gone needs no stopping
        finally:
            self._port.close()

    def _handshake(self) -> messages.Info:
        self._read_at = self._clock()
        self._port.clear()
        return self._request(messages.Hello(), messages.Info)

    def _require_same(self, found: messages.Info) -> None:
        known = self.info
        if (found.uid, found.table_crc32) != (known.uid, known.table_crc32):
            raise UnrecoverableError(
                f"{self.uri}: expected board {known.uid.hex()}, table {known.table_crc32:08x}; "
                f"found board {found.uid.hex()}, table {found.table_crc32:08x}; what was learned "
                "of one sensor does not fit another, start again"
            )

    def _discard_received(self) -> None:
        """Discard messages, parts of frames and bytes that were received before now."""
        self._port.clear()
        self._inbox.clear()
        self._assembly.clear()

    def _read_table(self) -> messages.Table:
        """Measurement table of the board, in one packet or in parts."""
        n = self.info.n_measurements
        if n <= PER_PACKET:
            return self._request(messages.GetTable(), messages.Table)
        table = messages.Table(())
        for _ in range(n):  # an answer to an earlier request may come late, and is passed over
            part = self._request(messages.GetTable(len(table.rows)), messages.TablePart)
            if part.first == len(table.rows):
                table = messages.Table(table.rows + part.rows)
            if len(table.rows) >= n:
                break
        return table

    def _read_protocol(self) -> Protocol:
        table = self._read_table()
        key = (self.info.n_measurements, self.info.table_crc32)
        if (len(table.rows), table.crc32) != key:
            raise DeviceError(
                f"{self.uri}: the board announced a table of {key[0]} measurements with CRC "
                f"{key[1]:08x} and sent {len(table.rows)} with CRC {table.crc32:08x}; its "
                "firmware contradicts itself, flash a good one"
            )
        try:
            return Protocol.from_rows(table.rows, self.info.n_electrodes)
        except ConfigurationError as error:
            raise DeviceError(
                f"{self.uri}: the board's measurement table cannot be: {error}; flash a good one"
            ) from error

    def _start(self) -> None:
        """Start the frames; frames before the acknowledgement are old and are passed over."""
        self._request(messages.Start(), messages.Ack)
        self._restarted = False

    def _next_frame(self) -> Frame:
        # A board that starts again and again gives no frame either.
        for message in self._receive_items(self._patience):
            if (frame := self._frame(message)) is not None:
                return frame
            if self._restarted:
                self._start()
        raise DeviceError(
            f"{self.uri}: the stream is stale, no frame came for {self._patience:.3f} s, with one "
            f"due every {self.info.period:.3f} s{self._received_instead()}; check power and cable, "
            "then connect again"
        )

    @property
    def _patience(self) -> float:
        """Longest time without a frame [s]."""
        return longest_silence(self.info.period)

    def _discard_old(self) -> None:
        """Discard the data waiting in a port that was not read for long.

        The queues then hold the oldest frames, and the board's own queue holds one more.
        """
        if self._clock() - self._read_at > self._patience:
            self._discard_received()
            lost = self._lost
            self._next_frame()
            self._skipped += 1 + self._lost - lost  # those frames did come
            self._lost = lost

    def _frame(self, item: messages.Message) -> Frame | None:
        if isinstance(item, FrameData):
            return self._accept(item)
        self._note(item)
        return None

    def _accept(self, data: FrameData) -> Frame | None:
        """Frame in `data`; None for a late one, or one of another measurement table."""
        if len(data.impedance) != len(self.protocol):
            self._drop_malformed(
                f"FRAME of {len(data.impedance)} channels, expected {len(self.protocol)}"
            )
            return None
        gap = 0 if self._expected is None else (data.number - self._expected) % 2**32
        if gap >= 2**31:  # the number is behind: numbers wrap
            if not self._resuming:
                self._decoder.drops[PacketDrop.STALE] += 1
                return None
            gap = 0  # the board counts again although its boot count is the same
        self._resuming = False
        self._lost += gap
        self._expected = (data.number + 1) % 2**32
        if data.kind != 0:
            return None
        status = data.status.copy()
        status[~np.isfinite(data.impedance)] |= np.uint8(Status.NOT_FINITE)
        return Frame(
            impedance=data.impedance.astype(np.complex128),
            protocol=self.protocol,
            time=data.time,
            number=data.number,
            session=self.info.boot_count,
            frequency=self.info.frequency,
            status=status,
            duration=data.duration,
        )

    def _note(self, message: messages.Message) -> None:
        """Handle a message that answers no request: an event, or the Info of a restart."""
        if isinstance(message, messages.Event):
            self.events.append(message)
            log.info("%s: %s", self.uri, message.text)
        elif isinstance(message, messages.Info) and message.boot_count != self.info.boot_count:
            self._require_same(message)
            self.info = message
            self._restarted, self._expected = True, None

    def _request(self, request: messages.Request, answer: type[Answer]) -> Answer:
        """Answer to `request`, which is repeated under the same number until answered."""
        self._seq = (self._seq + 1) % 2**16
        for _ in range(TRIES):
            self._send(request, self._seq)
            for message in self._receive_items(REPLY_TIMEOUT):
                if isinstance(message, messages.Ack):
                    if message.request != self._seq:
                        continue
                    self._require_done(request, message)
                if isinstance(message, answer):
                    return message
                self._note(message)
        raise DeviceError(
            f"{self.uri}: expected an answer to {type(request).__name__.upper()} within "
            f"{REPLY_TIMEOUT:g} s, none came in {TRIES} tries{self._received_instead()}; check "
            "that this is the EIT board, its power and its cable"
        )

    def _require_done(self, request: messages.Request, ack: messages.Ack) -> None:
        if ack.status != messages.AckStatus.DONE:
            is_known = ack.status in messages.AckStatus.__members__.values()
            reason = (
                messages.AckStatus(ack.status).name.lower() if is_known else f"status {ack.status}"
            )
            # A board that failed has an event that says what to check.
            failed = ack.status == messages.AckStatus.FAILED and self._complaint()
            remedy = "" if failed else "; check that its firmware fits this eitskin"
            raise DeviceError(
                f"{self.uri}: the board refused {type(request).__name__.upper()}: "
                f"{reason.replace('_', ' ')}{self._received_instead()}{remedy}"
            )

    def _complaint(self) -> str:
        """Text of the newest event, where that is a warning or an error."""
        return self.events[-1].text if self.events and self.events[-1].level > 0 else ""

    def _received_instead(self) -> str:
        """Hint, in parentheses, at data that came instead of a frame or an answer."""
        if complaint := self._complaint():
            return f" (its firmware says: {complaint})"
        drops, lines = self._decoder.drops, self._latest.split(b"\n")
        line = max(lines[-2:], key=len).strip()
        if len(line) > 3 and line.isascii() and line.decode().isprintable():
            return (
                f" (it printed '{shorten_text(line.decode())}'; a board that prints lines is "
                "opened by text:PORT?protocol=, such as protocol=adjacent:16)"
            )
        if drops[PacketDrop.VERSION]:
            return " (it speaks another version of the protocol: update eitskin or the firmware)"
        if self._malformed:
            return f" (it sent {self._malformed})"
        if drops.total():
            return f" (dropped: {dict(self.counts.dropped)}; a wrong baud rate looks like this)"
        return ""

    def _send(self, request: messages.Request, seq: int) -> None:
        self._port.write(encode(messages.pack(request, seq)))

    def _receive(self) -> None:
        self._read_at = self._clock()
        data = self._port.read()
        self._latest = (self._latest + data)[-256:]
        for packet in self._decoder.feed(data):
            try:
                message = messages.unpack(packet)
            except MessageError as error:
                self._drop_malformed(str(error))
                continue
            frame = self._assembly.add(message) if isinstance(message, FramePart) else message
            if frame is not None:
                self._inbox.append(frame)

    def _drop_malformed(self, what: str) -> None:
        self._decoder.drops[PacketDrop.MALFORMED] += 1
        self._malformed = what


def open_serial(path: str, uri: str, **options: Any) -> SerialBoard:
    """Open a board that speaks the wire protocol; the options are those of `connector`."""
    return SerialBoard(connector(path, uri, **options), uri)
