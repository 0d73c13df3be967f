"""Simulated AD5940 behind its SPI: registers in, transforms out.

The simulation follows the data sheet and nothing of the firmware. Accesses that make no
sense are kept in `complaints`.
"""

import numpy as np

from eitskin.simulator.instrument.ad5940 import (
    CODES,
    EXCITATIONS,
    PGA_RANGES,
    TIA_LIMIT,
    TRANSIMPEDANCES,
    clipped_fundamental,
    quantise,
)

MCLK = 16e6
SETADDR, WRITEREG, READREG = 0x20, 0x2D, 0x6D
DFTRDY, ADCMINERR, ADCMAXERR = 1 << 1, 1 << 4, 1 << 5
GAINS = (1.0, 1.5, 2.0, 4.0, 9.0)
RANGES = (PGA_RANGES[3], *PGA_RANGES[::-1])  # [V], of each gain
POINTS = [4 << code for code in range(13)]
OVERSAMPLING = (5, 4, 2)
POWER = (6, 7, 9, 10, 11, 14, 20)  # DACEN ADCEN EXBUFEN INAMPEN TIAEN WAVEGENEN DACREFEN

REQUIRED = bytes.fromhex(
    "090802c9 0c08206c 21f000000010 041002c9 0a280009 238c00000104 0a044859 0a04f27b 0a008009"
    "22f000000000 2230de87a5af 22500000103f 22b00000203c 2230de87a5a0"
)
"""Addresses and values to be written after a reset, by the data sheet."""

KNOWN = {
    *(0x0000, 0x0004, 0x0400, 0x0404, 0x2000, 0x200C, 0x2010, 0x2014, 0x2030, 0x2034, 0x2038),
    *(0x203C, 0x2044, 0x2078, 0x207C, 0x20A8, 0x20AC, 0x20B0, 0x20B4, 0x20D0, 0x20F0, 0x20F8),
    *(0x20FC, 0x2150, 0x2154, 0x2158, 0x215C, 0x2180, 0x21A8, 0x22F0, 0x3000, 0x3004, 0x3008),
    *(0x300C, 0x3014),
}
SENSOR = {0x2150: 1 << 4, 0x2158: 1 << 10, 0x2154: 1 << 1, 0x215C: 1 << 8 | 1 << 1}  # CE0, AIN1
CALIBRATION = {0x2150: 1, 0x2158: 1, 0x2154: 1 << 9, 0x215C: 1 << 8 | 1 << 11}  # RCAL0, RCAL1


class SimulatedAfe:
    """The registers, and the analog parts behind them.

    Attributes:
        impedance: of a row (drive+, drive-, sense+, sense-), complex [ohm].
        electrodes: where the four multiplexers stand.
        rcal: true value of the calibration resistor [ohm].
        rtia_factor, voltage_factor: by how much the current and the voltage channel are off,
            complex.
        present: whether it answers.
        stuck: rows whose transform never ends.
        comparators: whether ADCMIN and ADCMAX work.
        now: time [us], moved by whoever owns the part.
        complaints: what it was told that makes no sense.
        seen: the settings of each transform.
    """

    def __init__(self, impedance):
        self.impedance = impedance
        self.electrodes = [None] * 4
        self.rcal, self.rtia_factor, self.voltage_factor = 200.0, 1.0, 1.0
        self.present, self.comparators, self.stuck = True, True, set()
        self.now = 0.0
        self.complaints, self.seen = [], []
        self.reset()

    def reset(self):
        self._registers = {0x0400: 0x4144, 0x0404: 0x5502, 0x2000: 1 << 19}
        self._address = self._flags = 0
        self._written = b""
        self._done_at = None

    @property
    def interrupts(self):
        """Whether the pin of interrupt 0 is pulled low."""
        self._advance()
        enabled = self[0x0004] & 1 and not self[0x0000] & 3
        return bool(enabled and self._flags & self[0x3008])

    @property
    def done_at(self):
        """End of the running transform [us]; None without one."""
        return self._done_at

    def __getitem__(self, address):
        return self._registers.get(address, 0)

    def transfer(self, out):
        """Bytes received for those sent in one chip select."""
        if not self.present:
            return b"\xff" * len(out)
        self._advance()
        width = 4 if 0x1000 <= self._address <= 0x3014 else 2
        command, data = out[0], out[1:]
        if command == SETADDR and len(data) == 2:
            self._address = int.from_bytes(data, "big")
        elif command == WRITEREG and len(data) == width:
            self._write(self._address, data)
        elif command == READREG and len(data) == 1 + width:
            return b"\0\0" + self._read(self._address).to_bytes(width, "big")
        else:
            self.complaints.append(f"command {out.hex(' ')} at {self._address:#06x}")
        return bytes(len(out))

    def _write(self, address, data):
        value = int.from_bytes(data, "big")
        if len(self._written) < len(REQUIRED):
            self._written += address.to_bytes(2, "big") + data
            if not REQUIRED.startswith(self._written):
                self.complaints.append(f"{address:#06x} written before the part was set up")
        elif address not in KNOWN:
            self.complaints.append(f"no register {address:#06x} is known")
        if address == 0x3004:
            self._flags &= ~value
        converting = 1 << 15 | 1 << 8
        if address == 0x2000 and value & converting != self[0x2000] & converting:
            self._registers[address] = value
            self._start() if value & converting == converting else self._halt()
        self._registers[address] = value

    def _read(self, address):
        if address == 0x3014:
            return self._flags & self[0x300C]
        if address not in KNOWN:
            self.complaints.append(f"no register {address:#06x} is known")
        return self[address]

    def _halt(self):
        self._done_at = None

    def _start(self):
        """Begin a transform: (points + 2) of the filter, at 20 clocks for each sample."""
        self._require("power", all(self[0x2000] >> bit & 1 for bit in POWER))
        self._require("no high-power reference", not self[0x2000] >> 5 & 1)
        self._require("DFT of the SINC3 filter", self[0x20D0] >> 20 & 3 == 1)
        self._require("Hanning window", self[0x20D0] & 1 == 1)
        self._require("ADC at 800 kSPS, filter in use", self[0x2044] & 0xC1 == 1)
        self._require("sinusoid", self[0x2014] >> 1 & 3 == 2)
        self._require("bandwidth above 40 kHz", self[0x22F0] >> 2 & 3 >= 2)
        self._require("references on", self[0x2180] & 0x11 == 0x11)
        self._require("switches from their registers", self[0x200C] >> 16 & 1 == 1)
        points = POINTS[self[0x20D0] >> 4 & 15]
        samples = (points + 2) * OVERSAMPLING[self[0x2044] >> 12 & 3] + 1
        self._flags &= ~DFTRDY
        self._phasor, on_sensor = self._voltage_at_adc()
        stuck = on_sensor and tuple(self.electrodes) in self.stuck
        self._done_at = None if stuck else self.now + samples * 20 / MCLK * 1e6
        self.seen.append(
            {
                "frequency": self[0x2030] * MCLK / 2**30,
                "amplitude": self._amplitude(),
                "points": points,
                "on_sensor": on_sensor,
                "range": RANGES[self[0x21A8] >> 16 & 7],
            }
        )

    def _require(self, what, good):
        if not good:
            self.complaints.append(f"a transform was started without: {what}")

    def _advance(self):
        if self._done_at is not None and self.now >= self._done_at:
            self._done_at = None
            self._finish()

    def _finish(self):
        """Round what the ADC saw to codes; DFTIMAG turns the other way round."""
        gain, full_range = (each[self[0x21A8] >> 16 & 7] for each in (GAINS, RANGES))
        peak = abs(self._phasor) * gain / 1.835 * 32768
        # The limits of the data sheet are where distortion begins, not where the ADC ends.
        self._flags |= DFTRDY
        if self.comparators:
            self._flags |= ADCMAXERR if 32768 + peak > self[0x20B0] else 0
            self._flags |= ADCMINERR if 32768 - peak < self[0x20A8] else 0
        shown = clipped_fundamental(np.array(self._phasor), np.array(self._limit(full_range)))
        codes = quantise(shown, np.array(full_range)) / (full_range / CODES)
        for address, code in ((0x2078, codes.real), (0x207C, -codes.imag)):
            self._registers[address] = round(np.clip(code, -CODES, CODES - 1)) & 0x3FFFF

    def _is_current(self):
        return self[0x21A8] & 0x1F3F == 0x0101  # HSTIA_P and HSTIA_N

    def _limit(self, full_range):
        rtia = TRANSIMPEDANCES[self[0x20F0] & 15]
        return min(full_range, TIA_LIMIT * rtia) if self._is_current() else full_range

    def _amplitude(self):
        """Amplitude of the excitation [V]: full scale by the two gains, times WGAMPLITUDE."""
        quarter, fifth = self[0x2010] >> 12 & 1, self[0x2010] & 1
        full = EXCITATIONS[{(0, 0): 0, (0, 1): 1, (1, 0): 2, (1, 1): 3}[quarter, fifth]]
        return full * (self[0x203C] & 0x7FF) / 2047

    def _voltage_at_adc(self):
        """The phasor [V] that the ADC is pointed at, and whether it is the sensor's."""
        switches = {address: self[address] for address in SENSOR}
        inputs = self[0x21A8] & 0x3F, self[0x21A8] >> 8 & 0x1F
        on_sensor = switches == SENSOR
        if not on_sensor and switches != CALIBRATION:
            self.complaints.append(f"switches at {switches}")
            return 0.0, False
        if on_sensor:
            drive_plus, drive_minus, *_ = self.electrodes
            driven = self.impedance((drive_plus, drive_minus, drive_plus, drive_minus))
            measured = self.impedance(tuple(self.electrodes))
        else:
            driven = measured = self.rcal
        current = self._amplitude() / driven
        if self._is_current():  # the amplifier inverts
            rtia = TRANSIMPEDANCES[self[0x20F0] & 15]
            return -current * rtia * self.rtia_factor, on_sensor
        expected = (0x06, 0x07) if on_sensor else (0x24, 0x14)  # AIN2, AIN3 or the nodes P, N
        if inputs != expected:
            self.complaints.append(f"ADC inputs {inputs}, expected {expected}")
        return current * measured * self.voltage_factor, on_sensor
