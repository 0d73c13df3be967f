"""Memory of the firmware's image, and instructions and time of one frame in emulation.

    PYTHONPATH=tests/support python -m emulator.figures

Needs arm-none-eabi-gcc and qemu-system-arm. Instructions are counted exactly, as the image runs;
cycles are not known, since QEMU has neither the pipeline nor the wait states of the flash.
"""

import bisect
import collections
import json
import re
import socket
import sys
from pathlib import Path

from eitskin.hardware.protocol.frame_parts import FrameData
from eitskin.hardware.protocol.messages import Ack, Calibrate, GetTable, Hello, Info, Start, Table

from emulator.board import CROSS, EmulatedBoard, image, run

RAM, TOP = 0x20000000, 0x20020000
UNTOUCHED = b"\xa5\xa5\xa5\xa5"
STRETCH = 256  # words
TRACE = re.compile(r"\[\w+/(\w+)/")
GROUPS = {
    "SPI and pins": ("front_end_", "exti15_10_interrupt"),
    "registers of the AD5940": ("eit_ad5940_", "write_register", "read_register", "set_address"),
    "packets": ("eit_put", "eit_crc32", "eit_begin", "eit_end", "put_raw", "stuff", "end_block"),
    "serial port": ("serial_", "usart2_interrupt", "send_waiting"),
    "clock and sleep": ("clock_", "tim5_interrupt", "idle"),
}


def sizes(images):
    """Bytes of code and tables, data and zeros, by the linker."""
    text, data, bss = map(int, run(f"{CROSS}size", images / "eitskin-f411.elf").split()[6:9])
    portable = sum(
        int(line.split()[0])
        for line in run(f"{CROSS}size", *images.glob("eit_*.o")).splitlines()[1:]
    )
    return {"code and tables": text, "of them portable": portable, "data and zeros": data + bss}


def symbols(images):
    """Addresses and names of functions, in their order."""
    rows = (row.split() for row in run(f"{CROSS}nm", images / "eitskin-f411.elf").splitlines())
    found = sorted((int(at, 16), name) for at, kind, name in rows if kind in "tT")
    return [at for at, _ in found], [name for _, name in found]


def memory(board, start, size):
    """RAM of the emulated machine, through its control socket."""
    with socket.socket(socket.AF_UNIX) as control:
        control.connect(f"{board.folder}/control")
        answers = control.makefile()
        answers.readline()
        where = {"val": start, "size": size, "filename": f"{board.folder}/ram"}
        for command, arguments in (("qmp_capabilities", {}), ("memsave", where)):
            request = {"execute": command, "arguments": arguments}
            control.sendall(json.dumps(request).encode() + b"\n")
            while "return" not in (answer := json.loads(answers.readline())):
                assert "error" not in answer, answer
    return Path(board.folder, "ram").read_bytes()


def stack(ram):
    """Bytes of the stack that were ever written: down to the first long untouched stretch."""
    words = [ram[at : at + 4] for at in range(0, len(ram), 4)]
    stretch = 0
    for depth, word in enumerate(reversed(words), start=1):
        stretch = stretch + 1 if word == UNTOUCHED else 0
        if stretch == STRETCH:
            return 4 * (depth - STRETCH)
    raise AssertionError("the stack reaches the variables")


def profile(log, names):
    """Instructions from the beginning of one frame to that of the next, by groups of functions."""
    addresses, functions = names
    frame = addresses[functions.index("eit_scan_start_frame")]
    begun, counts = 0, collections.Counter()
    with log.open(encoding="ascii", errors="replace") as lines:
        for line in lines:
            match = TRACE.search(line)
            if not match:
                continue
            at = int(match[1], 16)
            begun += at == frame
            if begun == 2:
                return counts
            if begun == 1:
                name = functions[bisect.bisect(addresses, at) - 1]
                counts[group(name)] += 1
    raise AssertionError("the log holds no two frames")


def group(name):
    return next((g for g, starts in GROUPS.items() if name.startswith(starts)), "the rest")


def main():
    """Print the figures."""
    images = image()
    trace = ("-singlestep", "-d", "exec,nochain", "-dfilter", "0x08000000+0x8000", "-D", "trace")
    control = ("-qmp", "unix:control,server=on,wait=off")
    with EmulatedBoard(options=(*trace, *control)) as board:
        board.wait_for(Info)
        for request, answer in ((Hello(), Info), (GetTable(), Table), (Calibrate(), Ack)):
            board.ask(request, answer)
        board.ask(Start(3), Ack)
        first, second, _ = (board.wait_for(FrameData)[0] for _ in range(3))
        ram = memory(board, RAM, TOP - RAM)
        counts = profile(Path(board.folder, "trace"), symbols(images))
    rows = [f"{name}: {value} bytes" for name, value in sizes(images).items()]
    rows.append(f"stack, at most: {stack(ram)} bytes")
    rows.append(f"instructions of a frame: {counts.total()}")
    rows += [f"  {name}: {count}" for name, count in counts.most_common()]
    rows.append(f"frame, with an instruction as one cycle of 96 MHz: {first.duration * 1e3:.1f} ms")
    rows.append(f"period: {(second.time - first.time) * 1e3:.1f} ms")
    sys.stdout.write("\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
