"""The firmware in C, built with the host's compiler, with a simulated AD5940 behind it.

Its clock is virtual: SPI takes the time that it takes at 16 MHz, and being idle leads to whatever
comes next.
"""

import atexit
import ctypes as c
import functools
import shutil
import subprocess
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pytest

from eitskin import hardware
from eitskin.hardware import Info
from eitskin.hardware.protocol.messages import Ack, Start, pack, unpack
from eitskin.hardware.protocol.packets import Decoder, MessageType, encode
from eitskin.hardware.virtual.memory_line import MemoryLine, PseudoTerminal

from loopback import FLAT, PROTOCOL
from simulated_afe import SimulatedAfe

SOURCES = Path(hardware.__file__).parent / "firmware"
HERE = Path(__file__).parent
COMPILER = next(filter(shutil.which, ("cc", "gcc", "clang")), None)
WARNINGS = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror")
FOREVER = 2**64 - 1
LONG = 500_000  # us; all that happens by itself takes less
US_PER_BYTE = 0.5  # SPI at 16 MHz
UID = b"uid-of-12-by"


@functools.cache
def _folder():
    folder = tempfile.mkdtemp(prefix="eitskin-firmware-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


@functools.cache
def build(source, *options):
    """The firmware together with one file of the tests, compiled; skips where nothing compiles."""
    if COMPILER is None:
        pytest.skip("no C compiler (cc, gcc or clang) was found to build the firmware with")
    built = _folder() / f"{Path(source).stem}{len(options)}"
    command = [COMPILER, *WARNINGS, *options, "-I", SOURCES, *SOURCES.glob("*.c"), HERE / source]
    done = subprocess.run([*command, "-o", built], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return built


@functools.cache
def library():
    """The firmware as a shared library."""
    loaded = c.CDLL(str(build("firmware_shim.c", "-O1", "-shared", "-fPIC")))
    pointer, size = c.c_void_p, c.c_size_t
    for name, result, *arguments in (
        ("eit_boot", c.c_bool, pointer, c.POINTER(Hal), c.POINTER(Config)),
        ("eit_poll", None, pointer),
        ("shim_size", size),
        ("shim_is_streaming", c.c_bool, pointer),
        ("shim_unsent", size, pointer),
        ("shim_number", c.c_uint32, pointer),
        ("shim_set_number", None, pointer, c.c_uint32),
        ("shim_encode", size, c.c_uint8, c.c_uint8, c.c_uint16, c.c_char_p, size, pointer, size),
        ("shim_decode", size, c.c_char_p, size, pointer),
    ):
        function = getattr(loaded, name)
        function.restype, function.argtypes = result, arguments
    return loaded


_HAL = {
    "spi_transfer": c.CFUNCTYPE(None, c.c_void_p, c.c_void_p, c.c_void_p, c.c_size_t),
    "afe_reset": c.CFUNCTYPE(None, c.c_void_p, c.c_bool),
    "afe_interrupt": c.CFUNCTYPE(c.c_bool, c.c_void_p),
    "mux_select": c.CFUNCTYPE(None, c.c_void_p, c.c_int, c.c_uint8),
    "uart_read": c.CFUNCTYPE(c.c_size_t, c.c_void_p, c.c_void_p, c.c_size_t),
    "uart_write": c.CFUNCTYPE(c.c_size_t, c.c_void_p, c.c_void_p, c.c_size_t),
    "clock_us": c.CFUNCTYPE(c.c_uint64, c.c_void_p),
    "unique_id": c.CFUNCTYPE(None, c.c_void_p, c.c_void_p),
    "next_boot_count": c.CFUNCTYPE(c.c_uint32, c.c_void_p),
    "idle": c.CFUNCTYPE(None, c.c_void_p, c.c_uint64),
}


class Hal(c.Structure):
    _fields_ = (("context", c.c_void_p), *_HAL.items())


class Config(c.Structure):
    _fields_ = (
        ("firmware", c.c_char_p),
        ("table", c.c_void_p),
        ("n_measurements", c.c_uint16),
        ("n_electrodes", c.c_uint8),
        ("excitation", c.c_uint8),
        ("rtia", c.c_uint8),
        ("pga", c.c_uint8),
        ("frequency_hz", c.c_float),
        ("rcal_ohm", c.c_float),
        ("open_ohm", c.c_float),
        ("settle_us", c.c_uint32),
        ("period_us", c.c_uint32),
    )


def config(table=None, **changes):
    """The default configuration with some of it changed."""
    chosen = Config.from_buffer_copy(Config.in_dll(library(), "eit_pairwise_8"))
    if table is not None:
        chosen.rows = c.create_string_buffer(bytes(e for row in table for e in row))
        chosen.table, chosen.n_measurements = c.addressof(chosen.rows), len(table)
    for name, value in changes.items():
        setattr(chosen, name, value)
    return chosen


class CompiledFirmware:
    """A board: the ten functions in Python, all else in C. A `Firmware` of pseudo_terminal.py.

    Attributes:
        afe: the simulated AD5940.
        info: what it said of itself when it booted.
        line: bytes that the UART takes from now on; None for any number.
    """

    delay, holds_port, plugged_in = 0.0, False, True

    def __init__(self, afe, configuration=None):
        self.afe = afe
        self.line = None
        self._library = library()
        self._config = configuration or config()
        self._memory = c.create_string_buffer(self._library.shim_size())
        self._board = c.cast(self._memory, c.c_void_p)
        self._hal = Hal(None, *(kind(getattr(self, name)) for name, kind in _HAL.items()))
        self._boots = 0
        self._incoming, self._outgoing = bytearray(), bytearray()

    # ---- what a terminal asks ----

    @property
    def streaming(self):
        return self._library.shim_is_streaming(self._board)

    @property
    def number(self):
        return self._library.shim_number(self._board)

    @number.setter
    def number(self, number):
        self._library.shim_set_number(self._board, number)

    def boot(self):
        self._incoming.clear()
        assert self._library.eit_boot(self._board, self._hal, self._config)
        self._idle_for = 0.0
        sent = self._run(lambda: self._idle_for < LONG)  # it rests, or looks for its AFE in vain
        infos = (unpack(packet) for packet in Decoder().feed(sent))
        self.info = next(message for message in infos if isinstance(message, Info))
        return sent

    def hear(self, data):
        """Have bytes come in that wait until the main loop goes round."""
        self._incoming += data

    def receive(self, data):
        self.hear(data)
        return self._run(lambda: self._incoming or self._can_send)

    def frame(self):
        number = self.number
        return self._run(lambda: (self.streaming and self.number == number) or self._can_send)

    def skip(self):
        line, self.line = self.line, 0
        self._outgoing += self.frame()
        self.line = line

    def poll(self, times=1):
        """Go round the main loop; what was sent meanwhile."""
        for _ in range(times):
            self._library.eit_poll(self._board)
        sent = bytes(self._outgoing)
        self._outgoing.clear()
        return sent

    @property
    def _can_send(self):
        return self.line != 0 and self._library.shim_unsent(self._board) > 0

    def _run(self, unfinished):
        sent = self.poll()
        while unfinished():
            sent += self.poll()
        return sent

    # ---- what the firmware asks ----

    def spi_transfer(self, _, out, in_, n):
        self.afe.now += n * US_PER_BYTE
        c.memmove(in_, self.afe.transfer(c.string_at(out, n)), n)

    def afe_reset(self, _, held):
        if held:
            self.afe.reset()

    def afe_interrupt(self, _):
        return self.afe.interrupts

    def mux_select(self, _, mux, electrode):
        self.afe.electrodes[mux] = electrode

    def uart_read(self, _, data, n):
        taken = bytes(self._incoming[:n])
        del self._incoming[:n]
        c.memmove(data, taken, len(taken))
        return len(taken)

    def uart_write(self, _, data, n):
        n = min(n, 4096 if self.line is None else self.line)
        if self.line is not None:
            self.line -= n
        self._outgoing += c.string_at(data, n)
        return n

    def clock_us(self, _):
        return int(self.afe.now)

    def unique_id(self, _, uid):
        c.memmove(uid, UID, len(UID))

    def next_boot_count(self, _):
        self._boots += 1
        return self._boots

    def idle(self, _, until):
        self._idle_for = until - self.afe.now
        ends = [until] if self.afe.done_at is None else [until, self.afe.done_at]
        if min(ends) < FOREVER:
            self.afe.now = max(self.afe.now, min(ends))


def sensor(values=FLAT, protocol=PROTOCOL):
    """Impedances by row, as an AFE asks for them."""
    return dict(zip(protocol.table, values, strict=True)).__getitem__


def compiled_board(values=FLAT, **changes):
    """A board of the default configuration, or of one with some of it changed, on a sensor."""
    return CompiledFirmware(SimulatedAfe(sensor(values)), config(**changes))


@contextmanager
def compiled_terminal(values=FLAT, period=0.0, **changes):
    """A pseudo-terminal that serves such a board, as fast as it is read."""
    with PseudoTerminal(MemoryLine(compiled_board(values, **changes), period)) as terminal:
        yield terminal


# ---- what tests do with a board ----


def messages(data):
    """The messages in whole packets; anything else fails."""
    decoder = Decoder()
    found = [unpack(packet) for packet in decoder.feed(data)]
    assert not decoder.drops
    assert decoder.buffered_bytes == 0
    return found


def booted(values=FLAT, **changes):
    board = compiled_board(values, **changes)
    board.boot()
    return board


def ask(board, request, seq=1):
    return messages(board.receive(encode(pack(request, seq))))


def frames(board, count):
    assert ask(board, Start(count)) == [Ack(1, MessageType.START)]
    taken = [message for _ in range(count) for message in messages(board.frame())]
    assert not board.streaming
    return taken


def fuzzer():
    """The firmware as a program; with the compiler's sanitizers, if it has them."""
    try:
        return build(
            "firmware_fuzz.c", "-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover"
        )
    except AssertionError:
        return build("firmware_fuzz.c", "-O1")
