"""USART2 with bytes that take their time, in place of QEMU's, which sends in no time."""

import time

SR, DR, BRR, CR1 = 0x00, 0x04, 0x08, 0x0C
ORE, RXNE, TC, TXE = 1 << 3, 1 << 5, 1 << 6, 1 << 7
BITS = 10  # 8N1
PINS = ("serial out", "serial in")


class Line:
    """The host's end of a line, a serial port, with the bytes on their way.

    Attributes:
        slower: by how much bytes of the board take longer than the baud rate says.
        sent: what the board has sent.
        waiting: what the board has not received yet.
        baud: rate that the board has chosen.
    """

    def __init__(self):
        self.slower, self.baud = 1.0, None
        self.sent, self.waiting = bytearray(), bytearray()

    @property
    def in_waiting(self):
        return len(self.sent)

    def read(self, size=1):
        """Bytes that have come, at least one; a board that says nothing fails."""
        give_up = time.monotonic() + 600.0
        while not self.sent:
            assert time.monotonic() < give_up
            time.sleep(0.002)
        data = bytes(self.sent[:size])
        del self.sent[: len(data)]
        return data

    def write(self, data):
        self.waiting += data

    def reset_input_buffer(self):
        self.sent.clear()

    def close(self):
        pass


class Usart:
    """Registers; data and shift register each hold one byte."""

    def __init__(self, chip, line):
        self._chip, self._line = chip, line
        self._brr = self._cr1 = 0
        self._data = self._free_at = None  # byte behind the one being shifted, and that one's end
        self._received, self._overrun = None, False
        self._next_in = None

    @property
    def _byte_us(self):
        self._line.baud = self._chip.bus_clock(10) / self._brr
        return BITS / self._line.baud * 1e6

    @property
    def next_event(self):
        times = [time for time in (self._free_at, self._next_in) if time is not None]
        return min(times) if times else None

    def advance(self):
        """Move bytes on; whether the interrupt is pending."""
        if not self._cr1 >> 13 & 1:
            return False
        now = self._chip.now
        while self._free_at is not None and now >= self._free_at:
            end, self._free_at = self._free_at, None
            if self._data is not None:
                self._shift(self._data, end)
                self._data = None
        self._receive(now)
        return bool(self._status() & self._cr1 & (RXNE | TXE))

    def _receive(self, now):
        if not self._line.waiting:
            self._next_in = None
            return
        if self._next_in is None:
            self._next_in = now + self._byte_us
        while self._line.waiting and now >= self._next_in:
            byte = self._line.waiting.pop(0)
            self._overrun |= self._received is not None
            self._received = byte if self._received is None else self._received
            self._next_in += self._byte_us

    def _shift(self, byte, start):
        self._line.sent.append(byte)
        self._free_at = start + self._byte_us * self._line.slower

    def _status(self):
        status = TXE if self._data is None else 0
        status |= TC if self._free_at is None else 0
        status |= RXNE if self._received is not None else 0
        return status | (ORE if self._overrun else 0)

    def access(self, offset, value):
        self.advance()
        if value is None:
            if offset == DR:
                byte, self._received, self._overrun = self._received or 0, None, False
                return byte
            return {SR: self._status(), BRR: self._brr, CR1: self._cr1}.get(offset, 0)
        if offset == DR:
            self._send(value)
        elif offset == BRR:
            self._brr = value
        elif offset == CR1:
            self._cr1 = value
        return 0

    def _send(self, value):
        pins, chip = self._chip.pins, self._chip
        if any(pins.function(*chip.pin_of(pin)) != 7 for pin in PINS):
            chip.complain("USART2 used without its pins")
        if self._data is not None:
            chip.complain("USART2 written while it is full")
        if self._free_at is None:
            self._shift(value & 0xFF, chip.now)
        else:
            self._data = value & 0xFF
