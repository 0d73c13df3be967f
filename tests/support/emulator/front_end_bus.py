"""SPI1, and the pins of the AD5940 and of the multiplexers."""

READREG = 0x6D
CR1, SR, DR = 0x00, 0x08, 0x0C
FASTEST = 16e6  # Hz, of the AD5940
SPI_PINS = ("SPI clock", "SPI in", "SPI out")
MUXES = ("F+", "F-", "S+", "S-")
AHEAD = 8  # bytes that the monitor may exchange by itself
HANG_US = 1000.0  # that one look at a dead SPI takes, to keep the wait for the watchdog short


class FrontEndBus:
    """Bytes between the chip select's edges, handed to the simulated AD5940 as one transfer.

    A byte is received as the one sent is written. The AD5940's answer depends on the first byte,
    so that the monitor exchanges the others by itself and tells them later.
    """

    def __init__(self, chip):
        self._chip = chip
        self._cr1 = 0
        self._selected, self._held = False, False
        self._sent, self._replies = bytearray(), b""

    def access(self, offset, value):
        if offset == SR and value is None:
            self._chip.take(HANG_US)
            return 0
        if offset == DR and value is not None:
            self.exchange(bytes([value & 0xFF]))
            return self._reply(len(self._sent) - 1)
        if offset != CR1:
            self._chip.complain(f"SPI1 has no register {offset:#x} for this")
        elif value is not None:
            self._cr1 = value
        return self._cr1

    def pin_changed(self):
        """Follow reset, chip select and the address lines."""
        pins, chip = self._chip.pins, self._chip
        held = pins.driven(*chip.pin_of("reset")) is False
        if held and not self._held:
            chip.afe.reset()
        self._held = held
        selected = pins.driven(*chip.pin_of("chip select")) is False
        if self._selected and not selected:
            self._end()
        if selected and not self._selected:
            self._sent, self._replies = bytearray(), b""
        self._selected = selected
        for mux, name in enumerate(MUXES):
            lines = [pins.driven(*chip.pin_of(f"{name} A{line}")) for line in range(4)]
            if None not in lines:
                chip.afe.electrodes[mux] = sum(high << line for line, high in enumerate(lines))

    def exchange(self, sent):
        """Have bytes gone out that were exchanged before."""
        if not sent:
            return
        self._check()
        if not self._sent and sent[0] == READREG:
            self._replies = self._exchange_read()
        self._sent += sent
        self._chip.take(len(sent) * 8e6 / self._baud)

    @property
    def to_come(self):
        """Bytes that come back for the next ones of this transfer."""
        return bytes(self._reply(len(self._sent) + ahead) for ahead in range(AHEAD))

    def _reply(self, at):
        idle = 0 if self._chip.afe.present else 0xFF
        return self._replies[at] if at < len(self._replies) else idle

    def _exchange_read(self):
        """The reply to a read of either width, told by the one that the part takes."""
        afe = self._chip.afe
        before = len(afe.complaints)
        reply = afe.transfer(bytes([READREG, 0, 0, 0]))
        if len(afe.complaints) > before:
            del afe.complaints[before:]
            reply = afe.transfer(bytes([READREG, 0, 0, 0, 0, 0]))
        return reply

    def _end(self):
        """Hand over a write, and check the length of a read."""
        if self._held:
            self._chip.complain("AD5940 spoken to in its reset")
        elif self._sent and self._sent[0] == READREG:
            if self._chip.afe.present and len(self._sent) != len(self._replies):
                self._chip.complain(f"read of {len(self._sent)} bytes")
        elif self._sent:
            self._chip.afe.transfer(bytes(self._sent))

    @property
    def _baud(self):
        return self._chip.bus_clock(13) / (2 << (self._cr1 >> 3 & 7))

    def _check(self):
        pins, chip, settings = self._chip.pins, self._chip, self._cr1
        for what, good in (
            ("master, enabled", settings >> 2 & 1 and settings >> 6 & 1),
            ("mode 0", settings & 3 == 0),
            ("MSB first, 8 bits", not settings >> 7 & 1 and not settings >> 11 & 1),
            ("select by software", settings >> 8 & 3 == 3),
            ("16 MHz at most", self._baud <= FASTEST),
            ("its pins", all(pins.function(*chip.pin_of(pin)) == 5 for pin in SPI_PINS)),
            ("chip select low", self._selected),
        ):
            if not good:
                chip.complain(f"SPI used without: {what}")
