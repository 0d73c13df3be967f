"""Needs of a live session on a robot's computer: space, time to the first estimate, and hours.

Run by `python -m eitskin.benchmarks.studies.boards.robot [--hours H]`, in an environment that has
the extras `live` and `websocket` and nothing else, where its size is to be that of the page.

With --hours, a session of so many hours of the AD5940's frames, as fast as they can be made,
through all states, with page, UDP and WebSocket, a client that is slow and one that reads nothing.
"""

import argparse
import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any

from eitskin.benchmarks.studies.boards.live_rate import MIXED
from eitskin.extras import require
from eitskin.hardware.virtual.virtual_board import virtual_terminal
from eitskin.provenance import Provenance

RUN = "from eitskin.cli.entry import run; run()"
SLOW = 0.5  # s between two readings of the slow client


def live(*arguments: str) -> list[str]:
    """Command of a live session of the shipped pipeline that prints records."""
    return [sys.executable, "-c", RUN, "live", "reference.eitmodel", "--json", "-q", *arguments]


def size_of(folder: Path) -> float:
    """Space that the files of a folder take [MB]; links count nothing."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return sum(path.stat().st_blocks * 512 for path in files) / 1e6


def first_estimates(repeats: int, seed: int) -> Iterator[str]:
    """Times from the start of the command to its first record, the board waiting at a port."""
    walls, busy = [], []
    with virtual_terminal(speed="max", seed=seed) as terminal:
        for _ in range(repeats):
            began = time.perf_counter()
            command = live("--board", f"serial:{terminal.path}", "--frames", "1")
            process = subprocess.Popen(command, stdout=subprocess.PIPE)  # noqa: S603
            with closing(_output(process)) as lines:
                next(iter(lines))
                walls.append(time.perf_counter() - began)
                lines.read()
            used = os.wait4(process.pid, 0)[2]
            process.returncode = 0
            busy.append(used.ru_utime + used.ru_stime)
    yield f"- from the command to the first estimate [s]: {min(walls):.2f}"
    yield f"- processor time of it, the end of the session included [s]: {min(busy):.2f}"


def endure(hours: float, seed: int) -> Iterator[str]:
    """Resources of the session at each hour of the board's clock."""
    yield "| hour | frames | lost | resident, MiB | open files | threads | processor, ms a frame |"
    yield "|---|---|---|---|---|---|---|"
    with ExitStack() as stack:
        scene = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "scenes.toml"
        scene.write_text(MIXED, encoding="utf-8")
        unread = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        unread.bind(("127.0.0.1", 0))
        port = _free_port()
        streams = ["--udp", str(unread.getsockname()[1]), "--websocket", str(port)]
        board = f"virtual:?speed=max&instrument=ad5940&seed={seed}&scene={scene}"
        process = subprocess.Popen(  # noqa: S603
            live("--board", board, "--every-frame", "--page", "--page-port", "0", *streams),
            stdout=subprocess.PIPE,
        )
        stack.callback(process.wait)
        stack.callback(process.terminate)
        lines = _output(process)
        next(iter(lines))
        stack.enter_context(socket.create_connection(("127.0.0.1", port)))  # says nothing
        listener = threading.Thread(target=_listen_slowly, args=(port,), daemon=True)
        listener.start()
        due, frames = 1.0 / 60.0, 1
        for line in lines:
            frames += 1
            record = json.loads(line)
            if record["time"] < 3600.0 * due:
                continue
            yield f"| {due:.3g} | {frames} | {record['lost']} | {_held_by(process.pid, frames)} |"
            if due >= hours:
                return
            due = min(due + 1.0, hours) if due >= 1.0 else 1.0


def _output(process: "subprocess.Popen[bytes]") -> Any:
    assert process.stdout is not None  # noqa: S101
    return process.stdout


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def _listen_slowly(port: int) -> None:
    """Read a record every now and then; the session's end ends this, too."""
    connect = require("websockets.sync.client", "websocket").connect
    with suppress(Exception), connect(f"ws://127.0.0.1:{port}/", ping_interval=None) as client:
        for _ in client:
            time.sleep(SLOW)


def _held_by(pid: int, frames: int) -> str:
    process = Path(f"/proc/{pid}")
    pages = int((process / "statm").read_text(encoding="ascii").split()[1])
    resident = pages * os.sysconf("SC_PAGE_SIZE") / 2**20
    files, threads = (len(list((process / name).iterdir())) for name in ("fd", "task"))
    fields = (process / "stat").read_text(encoding="ascii").rpartition(")")[2].split()
    ticks = int(fields[11]) + int(fields[12])
    busy = 1e3 * ticks / os.sysconf("SC_CLK_TCK") / frames
    return f"{resident:.1f} | {files} | {threads} | {busy:.2f}"


def main() -> None:
    """Print the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=0.0)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    print(f"Measured on {Provenance.now(given.seed)}\n")
    if given.hours:
        for line in endure(given.hours, given.seed):
            print(line, flush=True)
        return
    print(f"- environment [MB]: {size_of(Path(sys.prefix)):.0f}")
    for line in first_estimates(given.repeats, given.seed):
        print(line, flush=True)


if __name__ == "__main__":
    main()
