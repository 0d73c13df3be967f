"""HTTP server of the live page: files, events and commands, for this machine only."""

import json
import logging
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any, cast

from eitskin.cli.page.commands import COMMANDS
from eitskin.errors import ConfigurationError
from eitskin.latest import Latest

log = logging.getLogger(__name__)

HOST = "127.0.0.1"
MOST_CLIENTS = 8
LARGEST_BODY = 4096  # bytes
ASSETS = {
    "index.html": "text/html; charset=utf-8",
    "style.css": "text/css; charset=utf-8",
    "icon.svg": "image/svg+xml",
    "main.js": "text/javascript; charset=utf-8",
    "channels.js": "text/javascript; charset=utf-8",
    "colours.js": "text/javascript; charset=utf-8",
    "controls.js": "text/javascript; charset=utf-8",
    "map.js": "text/javascript; charset=utf-8",
    "sensor.js": "text/javascript; charset=utf-8",
    "trace.js": "text/javascript; charset=utf-8",
}
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


@dataclass(frozen=True, slots=True)
class ClientLimits:
    """Time limits and buffer for browsers.

    Attributes:
        send: time limit for a browser that reads nothing [s].
        receive: time limit for a request to arrive [s].
        buffer: size of the system's buffer for one browser [bytes]; more would be old frames.
    """

    send: float = 5.0
    receive: float = 10.0
    buffer: int = 1 << 16


class Server(ThreadingHTTPServer):
    """Server of one page, with a thread for each request, all ended by `close`.

    Attributes:
        files: content type and bytes of each file, by path.
        events: messages that `/events` streams.
        hello: the first event of each stream.
        execute: takes path and body of a command; raises ConfigurationError.
        controlled: whether the board takes commands.
        watching: number of open streams.
    """

    daemon_threads = True

    def __init__(
        self,
        port: int,
        events: Latest[bytes],
        hello: bytes,
        execute: Callable[[str, bytes], None],
        controlled: bool,
        limits: ClientLimits,
    ) -> None:
        """Take the port, 0 for any; raises ConfigurationError where it cannot be had."""
        folder = resources.files("eitskin.cli.page") / "web"
        self.files = {
            f"/{name}": (kind, (folder / name).read_bytes()) for name, kind in ASSETS.items()
        }
        self.files["/"] = self.files["/index.html"]
        self.events, self.hello, self.execute = events, hello, execute
        self.controlled, self.limits = controlled, limits
        self.watching = 0
        self._open: dict[Any, threading.Thread] = {}
        self._lock = threading.Lock()
        try:
            super().__init__((HOST, port), _Handler)
        except (OSError, OverflowError) as error:
            raise ConfigurationError(
                f"cannot serve the page on port {port}: {error}; choose another port, or 0 for "
                "any that is free"
            ) from error
        # Names by which the page's own browser calls it; anything else came by another way.
        self.hosts = {f"{name}:{self.server_port}" for name in (HOST, "localhost")}
        self.origins = {f"http://{host}" for host in self.hosts}
        self._thread = threading.Thread(target=self._serve, name="page server", daemon=True)

    def start(self) -> None:
        """Start to serve, in a thread."""
        self._thread.start()

    def close(self) -> None:
        """End every request and free the port."""
        self.shutdown()
        self._thread.join()
        self.server_close()
        with self._lock:
            left = list(self._open.items())
        for request, _ in left:
            with suppress(OSError):  # the browser may be faster
                request.shutdown(socket.SHUT_RDWR)
        for _, thread in left:
            thread.join()

    def admit(self) -> bool:
        """Count a new stream; False where there are too many."""
        with self._lock:
            if self.watching >= MOST_CLIENTS:
                return False
            self.watching += 1
            return True

    def dismiss(self) -> None:
        """Count the end of a stream."""
        with self._lock:
            self.watching -= 1

    def process_request(self, request: Any, client_address: Any) -> None:
        """Handle a request in a new thread, which `close` waits for."""
        thread = threading.Thread(
            target=self.process_request_thread,
            args=(request, client_address),
            name="page request",
            daemon=True,
        )
        with self._lock:
            # Forgotten when their threads have ended, and no sooner: `close` waits for them.
            self._open = {each: by for each, by in self._open.items() if by.is_alive()}
            self._open[request] = thread
            thread.start()

    def handle_error(self, request: Any, client_address: Any) -> None:  # noqa: ARG002
        """Log an error, unless the browser disconnected."""
        if not isinstance(sys.exception(), OSError):
            log.exception("the page's server failed")

    def _serve(self) -> None:
        self.serve_forever(poll_interval=0.05)


class _Handler(BaseHTTPRequestHandler):
    """Handler of one request; HTTP/1.0, so that each connection has one request."""

    server_version, sys_version = "eitskin", ""

    @property
    def page(self) -> Server:
        return cast(Server, self.server)

    def setup(self) -> None:
        limits = self.page.limits
        self.request.settimeout(limits.receive)
        self.request.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, limits.buffer)
        super().setup()

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        if self._refused(path):
            return
        if path == "/events":
            self._stream()
        elif path in self.page.files:
            self._reply(HTTPStatus.OK, *self.page.files[path])
        else:
            self._reply_error(HTTPStatus.NOT_FOUND, f"there is no {path} here")

    def do_POST(self) -> None:
        path = self.path.partition("?")[0]
        length = self.headers.get("Content-Length", "")
        counted = length.isascii() and length.isdigit() and len(length) < 10
        # Read before anything is answered: closing with bytes unread would cut the answer off.
        body = self.rfile.read(min(int(length), LARGEST_BODY + 1)) if counted else b""
        if self._refused(path):
            return
        kind = self.headers.get("Content-Type", "").partition(";")[0].strip().lower()
        if path not in COMMANDS:
            self._reply_error(
                HTTPStatus.NOT_FOUND, f"expected a POST to {', '.join(COMMANDS)}, got {path}"
            )
        elif not self.page.controlled:
            self._reply_error(
                HTTPStatus.CONFLICT, "this board is not a virtual one and takes no commands"
            )
        elif kind != "application/json":
            self._reply_error(
                HTTPStatus.UNSUPPORTED_MEDIA_TYPE,
                f"expected Content-Type application/json, got {kind or 'none'}",
            )
        elif not counted:
            self._reply_error(HTTPStatus.LENGTH_REQUIRED, "a command needs a Content-Length")
        elif len(body) > LARGEST_BODY:
            self._reply_error(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
                f"a command has at most {LARGEST_BODY} bytes, got {length}",
            )
        else:
            self._execute(path, body)

    def _execute(self, path: str, body: bytes) -> None:
        try:
            self.page.execute(path, body)
        except ConfigurationError as error:
            self._reply_error(HTTPStatus.BAD_REQUEST, str(error))
        else:
            self._reply(HTTPStatus.OK, "application/json", b'{"done":true}')

    def _refused(self, path: str) -> bool:
        """Refuse a request that is not from this page itself; whether it was refused.

        A name other than this machine's means that a foreign one was made to point here (DNS
        rebinding); an Origin other than the page's, that a foreign page asks.
        """
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin")
        site = self.headers.get("Sec-Fetch-Site", "none")
        if host not in self.page.hosts:
            wrong = f"this page is called {self._url()}, not {host!r}"
        elif origin not in self.page.origins and not (origin is None and self.command == "GET"):
            wrong = f"only the page at {self._url()} may ask, not {origin or 'one without Origin'}"
        elif site not in ("none", "same-origin") and path != "/":
            wrong = f"only the page at {self._url()} may ask, not a {site} one"
        else:
            return False
        self._reply_error(HTTPStatus.FORBIDDEN, wrong)
        return True

    def _url(self) -> str:
        return f"http://{HOST}:{self.page.server_port}/"

    def _stream(self) -> None:
        """Send each newest event until the browser disconnects or stalls."""
        if not self.page.admit():
            self._reply_error(
                HTTPStatus.SERVICE_UNAVAILABLE, f"{MOST_CLIENTS} browsers watch already"
            )
            return
        try:
            self.connection.settimeout(self.page.limits.send)
            self.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            number = self.page.events.number
            self._head(HTTPStatus.OK, "text/event-stream")
            self.wfile.write(self.page.hello)
            while (newest := self.page.events.after(number)) is not None:
                number, message = newest
                self.wfile.write(message)
        except OSError:
            pass  # gone, or stalled for too long
        finally:
            self.page.dismiss()

    def _reply_error(self, status: HTTPStatus, message: str) -> None:
        self._reply(status, "application/json", json.dumps({"error": message}).encode())

    def _reply(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        self._head(status, kind, len(body))
        self.wfile.write(body)

    def _head(self, status: HTTPStatus, kind: str, length: int | None = None) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        if length is not None:
            self.send_header("Content-Length", str(length))
        for name, value in HEADERS.items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        """Log nothing: the terminal shows the sensor."""
