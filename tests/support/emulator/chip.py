"""Parts of an STM32F411 beside its core: clocks, pins, SPI, sleep timer, watchdog, flash.

They follow the reference manual (RM0383) and the pins `wiring.csv`, and nothing of the firmware's
source. Accesses that make no sense on the chip are kept in `complaints`.
"""

import csv
from pathlib import Path

from eitskin import hardware

from emulator.front_end_bus import FrontEndBus
from emulator.pins import Pins
from emulator.usart import Line, Usart

NEVER = 0xFFFFFFFF
RAISE_EXTI_10, RAISE_TIM5, RAISE_USART2, FORBID_USART2, RESET, SPI_HANGS = 1, 2, 4, 8, 16, 32
MHZ = 1e6
FLASH_SIZE = 0x8000
UID = bytes(range(0x31, 0x31 + 12))
WIRING = Path(hardware.__file__).parent / "firmware" / "nucleo_f411" / "wiring.csv"

# Peripheral: base address, and the register and bit that turn its clock on.
CLOCKED = {
    "GPIOA": (0x40020000, 0x30, 0),
    "GPIOB": (0x40020400, 0x30, 1),
    "GPIOC": (0x40020800, 0x30, 2),
    "TIM5": (0x40000C00, 0x40, 3),
    "USART2": (0x40004400, 0x40, 17),
    "PWR": (0x40007000, 0x40, 28),
    "SPI1": (0x40013000, 0x44, 12),
}
RCC, FLASH, IWDG, UNIQUE_ID, STORE = 0x40023800, 0x40023C00, 0x40003000, 0x1FFF7A10, 0x08008000


def wiring():
    """Pin of each signal, as ("A", 5)."""
    with WIRING.open(encoding="utf-8") as file:
        return {row["signal"]: (row["pin"][1], int(row["pin"][2:])) for row in csv.DictReader(file)}


class Chip:
    """The parts, and the front end behind them.

    Attributes:
        afe: the simulated AD5940.
        line: the host's end of the serial line.
        now: time since power came [us].
        crystal: whether the ST-LINK gives its 8 MHz.
        spi_hangs: whether SPI has stopped for ever.
        store: sectors 2 and 3 of flash.
        resets: how often the watchdog has struck.
        faults: program counters at which the firmware met a fault of its own.
        complaints: what it was told that makes no sense.
    """

    def __init__(self, afe):
        self.afe, self.line = afe, Line()
        self.crystal, self.spi_hangs = True, False
        self.now, self.resets = 0.0, 0
        self.store = bytearray(b"\xff" * FLASH_SIZE)
        self.complaints, self.faults = [], []
        self._wiring = wiring()
        self.power_on()

    def power_on(self):
        """Everything but time and flash as after a reset."""
        self.rcc = {0x00: 0x83, 0x08: 0, 0x30: 0, 0x40: 0, 0x44: 0}
        self.flash_keys, self.flash = [], {0x00: 0, 0x0C: 0, 0x10: 1 << 31}
        self.pwr = 0x8000
        self.tim5 = {0x00: 0, 0x0C: 0, 0x10: 0, 0x28: 0, 0x2C: 0xFFFFFFFF}
        self.wakes_at = None
        self.iwdg = {0x04: 0, 0x08: 0xFFF}
        self.unlocked, self.bites_at = False, None
        self.pins = Pins()
        self.bus = FrontEndBus(self)
        self.usart = Usart(self, self.line)
        self._took, self._told, self._last, self._was_low = 0.0, 0, None, False

    # ---- what the monitor asks ----

    def ask(self, kind, address, size, value, count, pc, sent):
        """Answer (value, actions, us to the next event, us that it took, bytes to come by SPI)."""
        self._pass(count)
        self._took -= self._told  # less than one microsecond stays
        self._told = 0
        if kind == "boot":
            return 0, FORBID_USART2, NEVER, 0, b""
        self.bus.exchange(sent)
        result = 0
        if kind in {"read", "write"}:
            result = self._access(address, None if kind == "read" else value, size)
        elif kind == "fault":
            self.faults.append(pc)
            self.take(1000.0)
        actions = self._actions()
        if actions & RESET:
            return 0, RESET, NEVER, 0, b""
        self._told = int(self._took)
        return result & 0xFFFFFFFF, actions, self._next_event(), self._told, self.bus.to_come

    def take(self, us):
        """Let time pass that no instruction takes."""
        self._took += us
        self.now += us
        self.afe.now = self.now

    def complain(self, text):
        self.complaints.append(text)

    def _pass(self, count):
        """Move the clock on by what timer 2 has counted."""
        if self._last is not None and self.rcc[0x40] & 1:
            passed = (count - self._last) & 0xFFFFFFFF
            if passed < 1 << 31:
                self.now += passed - self._told
        self._last = count
        self.afe.now = self.now

    def _actions(self):
        actions = RAISE_USART2 if self.usart.advance() else 0
        actions |= SPI_HANGS if self.spi_hangs else 0
        low = self.afe.interrupts
        if low and not self._was_low:
            actions |= RAISE_EXTI_10
        self._was_low = low
        if self.wakes_at is not None and self.now >= self.wakes_at:
            self.wakes_at = None
            self.tim5[0x00] &= ~1
            self.tim5[0x10] |= 1
            actions |= RAISE_TIM5 if self.tim5[0x0C] & 1 else 0
        if self.bites_at is not None and self.now >= self.bites_at:
            self.resets += 1
            self.power_on()
            return RESET
        return actions

    def _next_event(self):
        events = (self.afe.done_at, self.wakes_at, self.bites_at, self.usart.next_event)
        times = [event for event in events if event is not None]
        return max(1, int(min(times) - self.now) + 1) if times else NEVER

    # ---- registers ----

    def _access(self, address, value, size):
        if STORE <= address < STORE + FLASH_SIZE:
            return self._stored(address - STORE, value, size)
        if UNIQUE_ID <= address < UNIQUE_ID + len(UID):
            at = address - UNIQUE_ID
            return int.from_bytes(UID[at : at + size], "little")
        if size != 4:
            self.complain(f"{size} bytes accessed at {address:#010x}")
        for base, registers in ((RCC, self._rcc), (FLASH, self._flash), (IWDG, self._iwdg)):
            if base <= address < base + 0x400:
                return registers(address - base, value)
        for name, (base, enable, bit) in CLOCKED.items():
            if base <= address < base + 0x400:
                if not self.rcc[enable] >> bit & 1:
                    self.complain(f"{name} used without its clock")
                return getattr(self, f"_{name[:4].lower()}")(name, address - base, value)
        self.complain(f"nothing is known at {address:#010x}")
        return 0

    @property
    def sysclk(self):
        """Clock of the core [Hz]."""
        if self.rcc[0x08] >> 2 & 3 == 0:
            return 16 * MHZ
        settings = self.rcc[0x04]
        source = 8 * MHZ if settings >> 22 & 1 else 16 * MHZ
        m, n, p = settings & 0x3F, settings >> 6 & 0x1FF, 2 * (settings >> 16 & 3) + 2
        if not (1 * MHZ <= source / m <= 2 * MHZ and 100 * MHZ <= source / m * n <= 432 * MHZ):
            self.complain("the PLL runs outside its limits")
        return source / m * n / p

    def bus_clock(self, shift):
        """Clock of APB1 (10) or APB2 (13) [Hz]."""
        code = self.rcc[0x08] >> shift & 7
        return self.sysclk / (1 << max(0, code - 3) if code >= 4 else 1)

    def _rcc(self, offset, value):
        if value is None:
            return self.rcc.get(offset, 0)
        if offset == 0x00:
            value &= ~(1 << 17 | 1 << 25)
            value |= 1 << 17 if value >> 16 & 1 and self.crystal else 0
            value |= 1 << 25 if value >> 24 & 1 else 0
        if offset == 0x08:
            value = value & ~0xC | (value & 3) << 2
        if offset == 0x04 and self.rcc[0x00] >> 24 & 1:
            self.complain("PLL changed while it is on")
        self.rcc[offset] = value
        if offset == 0x08:
            self._check_clocks()
        return 0

    def _check_clocks(self):
        """Limits of the data sheet at 3.3 V."""
        sysclk = self.sysclk
        waits = sum(sysclk > limit * MHZ for limit in (30, 64, 90))
        for what, good in (
            ("no clock on the HSE", self.crystal or not self.rcc[0x04] >> 22 & 1),
            ("PLL off", self.rcc[0x00] >> 25 & 1),
            ("wait states", self.flash[0x00] & 0xF >= waits),
            ("voltage scale", sysclk <= 84 * MHZ or self.pwr >> 14 & 3 == 3),
            ("core", sysclk <= 100 * MHZ),
            ("APB1", self.bus_clock(10) <= 50 * MHZ),
        ):
            if not good:
                self.complain(f"clock switched without: {what}")

    def _pwr(self, _, offset, value):
        if value is None:
            return self.pwr if offset == 0 else 0
        if offset == 0:
            if self.rcc[0x00] >> 24 & 1:
                self.complain("voltage scale changed while the PLL is on")
            self.pwr = value
        return 0

    def _gpio(self, name, offset, value):
        return self.pins.access(name[4], offset, value, self)

    def _spi1(self, _, offset, value):
        return self.bus.access(offset, value)

    def _usar(self, _, offset, value):
        return self.usart.access(offset, value)

    def pin_of(self, signal):
        """Pin of a signal, as the wiring says."""
        return self._wiring[signal]

    def pin_changed(self):
        self.bus.pin_changed()

    def level(self, port, number):
        """What the pin would read as an input: the interrupt line, else pulled up."""
        if (port, number) == self.pin_of("interrupt"):
            return not self.afe.interrupts
        return True

    def _tim5(self, _, offset, value):
        if value is None:
            return self.tim5.get(offset, 0)
        if offset == 0x10:
            value &= self.tim5[0x10]
        self.tim5[offset] = value
        if offset == 0x00:
            if value & 1 and not value & 8:
                self.complain("the timer of the sleep runs more than once")
            tick = (self.tim5[0x28] + 1) / (2 * self.bus_clock(10)) * 1e6
            self.wakes_at = self.now + (self.tim5[0x2C] + 1) * tick if value & 1 else None
        return 0

    def _iwdg(self, offset, value):
        if value is None:
            return 0
        if offset == 0x00:
            self.unlocked = value == 0x5555 or (self.unlocked and value == 0xCCCC)
            if value == 0xCCCC or (value == 0xAAAA and self.bites_at is not None):
                ticks = (self.iwdg[0x08] + 1) * (4 << min(self.iwdg[0x04], 6))
                self.bites_at = self.now + ticks / 32e3 * 1e6
        elif not self.unlocked:
            self.complain("watchdog set without its key")
        else:
            self.iwdg[offset] = value
        return 0

    # ---- flash ----

    def _flash(self, offset, value):
        if value is None:
            return self.flash.get(offset, 0)
        if offset == 0x04:
            self.flash_keys = [*self.flash_keys, value][-2:]
            if self.flash_keys == [0x45670123, 0xCDEF89AB]:
                self.flash[0x10] &= ~(1 << 31)
        elif offset == 0x10:
            self._flash_control(value)
        elif offset == 0x0C:
            self.flash[0x0C] &= ~value
        else:
            self.flash[offset] = value
        return 0

    def _flash_control(self, value):
        if self.flash[0x10] >> 31:
            self.complain("flash is locked")
        elif value >> 16 & 1 and value >> 1 & 1:
            sector = value >> 3 & 0xF
            if sector not in {2, 3}:
                self.complain(f"sector {sector} of the flash erased")
            else:
                first = (sector - 2) * FLASH_SIZE // 2
                self.store[first : first + FLASH_SIZE // 2] = b"\xff" * (FLASH_SIZE // 2)
                self.take(250_000.0)
            value &= ~(1 << 16)
        self.flash[0x10] = value

    def _stored(self, at, value, size):
        if value is None:
            return int.from_bytes(self.store[at : at + size], "little")
        control = self.flash[0x10]
        if control >> 31 or not control & 1 or control >> 8 & 3 != 2 or size != 4:
            self.complain("flash written without being set up for 32 bits")
            return 0
        old = int.from_bytes(self.store[at : at + 4], "little")
        self.store[at : at + 4] = (old & value).to_bytes(4, "little")
        self.take(16.0)
        return 0
