"""Connections that never finish their requests, and what a process has open meanwhile."""

import resource
import socket
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from eitskin.benchmarks.studies.boards.chromium import Tab
from eitskin.benchmarks.studies.boards.live_windows import LiveLoop, Window

CONNECTIONS = 1000
ROUNDS = 8  # in which each connection that is still open sends a byte more
DESCRIPTORS = 4096  # of this process


@dataclass(frozen=True, slots=True)
class Held:
    """Threads, open files and memory of a process, the most in a window.

    Attributes:
        threads, files: numbers.
        memory_mb: resident [MB].
    """

    threads: int
    files: int
    memory_mb: float

    @classmethod
    def by(cls, process: int) -> "Held":
        """Threads, files and memory of a process of this machine now; Linux."""
        folder = Path("/proc") / str(process)
        lines = (folder / "status").read_text().splitlines()
        status = dict(line.split(":", 1) for line in lines)
        memory = int(status["VmRSS"].split()[0]) / 1024.0
        return cls(int(status["Threads"]), len(list((folder / "fd").iterdir())), memory)


def trickle(live: LiveLoop, tab: Tab, seconds: float) -> tuple[Window, Held, int]:
    """A window of the live loop beside connections that trickle.

    Returns the window, the most that the process held, and how many connections were still open
    at its end.
    """
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(DESCRIPTORS, most), most))
    address = urlsplit(live.url)
    with ExitStack() as stack:
        clients = []
        for _ in range(CONNECTIONS):
            client = socket.create_connection((address.hostname, address.port), timeout=10.0)
            clients.append(stack.enter_context(closing(client)))
            client.setblocking(False)
            _send(client, b"GET / HTTP/1.0\r\nX: ")
        windows, held = [], [Held.by(live.process.pid)]
        for _ in range(ROUNDS):
            name = f"{CONNECTIONS:,} connections that trickle"
            windows.append(live.watch(name, seconds / ROUNDS, tab))
            held.append(Held.by(live.process.pid))
            clients = [client for client in clients if _send(client, b"x")]
        most_held = Held(*(max(values) for values in zip(*map(_values, held), strict=True)))
        return Window.together(windows), most_held, len(clients)


def _send(client: socket.socket, data: bytes) -> bool:
    """Whether the server still has the connection."""
    with suppress(BlockingIOError):
        try:
            return client.recv(1, socket.MSG_PEEK) != b""
        except ConnectionError:
            return False
    try:
        client.send(data)
    except OSError:
        return False
    return True


def _values(held: Held) -> tuple[int, int, float]:
    return held.threads, held.files, held.memory_mb
