"""The image that is flashed, run in QEMU beside a `Chip` that plays what QEMU lacks."""

import atexit
import contextlib
import functools
import os
import shutil
import struct
import subprocess
import tempfile
import threading
from pathlib import Path

import pytest

from eitskin import hardware
from eitskin.hardware import SerialBoard
from eitskin.hardware.protocol.messages import pack, unpack
from eitskin.hardware.protocol.packets import Decoder, encode

from compiled_firmware import sensor
from emulator.chip import Chip
from simulated_afe import SimulatedAfe

HERE = Path(__file__).parent
FIRMWARE = Path(hardware.__file__).parent / "firmware" / "nucleo_f411"
CROSS = "arm-none-eabi-"
EMULATOR = "qemu-system-arm"
KINDS = ("read", "write", "tick", "boot", "fault")
QUESTION, ANSWER = struct.Struct("<7I8s"), struct.Struct("<4I8s")
STOP = 0xFFFFFFFF

MONITOR_OPTIONS = (
    *("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=soft", "-std=gnu99", "-O2", "-Wall", "-Wextra"),
    *("-ffreestanding", "-fno-tree-loop-distribute-patterns", "-nostdlib", "-Werror"),
)


def require(*programs):
    """Skip where a program is missing."""
    for program in programs:
        if shutil.which(program) is None:
            pytest.skip(
                f"no {program} was found: apt-get install gcc-arm-none-eabi qemu-system-arm"
            )


@functools.cache
def image():
    """Folder with the firmware and the monitor, built."""
    require("make", f"{CROSS}gcc")
    folder = Path(tempfile.mkdtemp(prefix="eitskin-f411-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    run("make", "-C", FIRMWARE, f"BUILD={folder}")
    monitor = ("-T", HERE / "monitor.ld", HERE / "monitor.c", "-o", folder / "monitor.elf")
    run(f"{CROSS}gcc", *MONITOR_OPTIONS, *monitor)
    return folder


def run(*command):
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


class EmulatedBoard:
    """A board whose firmware runs; a context manager.

    Attributes:
        chip: the parts that QEMU lacks.
        line: the host's end of its serial line.
    """

    def __init__(self, afe=None, crystal=True):
        require(EMULATOR)
        self.chip = Chip(afe or SimulatedAfe(sensor()))
        self.chip.crystal, self.line = crystal, self.chip.line
        self._decoder, self._seq = Decoder(), 0
        self._stack = contextlib.ExitStack()

    def __enter__(self):
        images = image()
        folder = self._stack.enter_context(tempfile.TemporaryDirectory())
        for name in ("asks", "told"):
            os.mkfifo(Path(folder) / name)
        # Open both ways: neither side then waits for the other, or sees an end.
        self._asks, self._told = (os.open(Path(folder) / n, os.O_RDWR) for n in ("asks", "told"))
        self._process = subprocess.Popen(
            [
                *(EMULATOR, "-machine", "netduinoplus2", "-display", "none", "-monitor", "none"),
                *("-icount", "shift=0,sleep=off", "-semihosting-config", "enable=on,target=native"),
                *("-kernel", images / "eitskin-f411.elf"),
                *("-device", f"loader,file={images / 'monitor.elf'},cpu-num=0"),
                *("-serial", "null"),
            ],
            cwd=folder,
        )
        self._thread = threading.Thread(target=self._answer, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._process.kill()
        self._process.wait()
        os.write(self._asks, QUESTION.pack(STOP, 0, 0, 0, 0, 0, 0, b""))
        self._thread.join()
        os.close(self._asks)
        os.close(self._told)
        self._stack.close()

    def _answer(self):
        """Play the chip until the end."""
        while True:
            question = os.read(self._asks, QUESTION.size)
            kind, address, size, value, count, pc, n, sent = QUESTION.unpack(question)
            if kind == STOP:
                return
            given = self.chip.ask(KINDS[kind], address, size, value, count, pc, sent[:n])
            os.write(self._told, ANSWER.pack(*given))

    # ---- the host ----

    def messages(self):
        """Messages as they come; a damaged packet fails."""
        while True:
            for packet in self._decoder.feed(self.line.read(4096)):
                yield unpack(packet)
            assert not self._decoder.drops

    def wait_for(self, kind):
        """The next message of a kind, and those before it."""
        before = []
        for message in self.messages():
            if isinstance(message, kind):
                return message, before
            before.append(message)
        raise AssertionError

    def serial_board(self):
        """The board as eitskin reads it, by a clock that stands still: emulation takes its time."""
        return SerialBoard(lambda: self.line, "serial:emulated", clock=lambda: 0.0)

    def ask(self, request, kind):
        self._seq += 1
        self.line.write(encode(pack(request, self._seq)))
        return self.wait_for(kind)[0]
