"""HTTP server of the live page: files, events and commands, for those who may have them."""

import io
import json
import logging
import socket
import threading
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from http.server import BaseHTTPRequestHandler
from importlib import resources
from typing import Any, cast

from eitskin.cli.page.access import Access, Role, resolved
from eitskin.cli.page.arrivals import LARGEST_BODY, MOST_ARRIVING, Arrivals
from eitskin.cli.page.commands import ConflictError, PageCommands, entered
from eitskin.errors import ConfigurationError
from eitskin.latest import Latest

log = logging.getLogger(__name__)

MOST_CLIENTS = 8
MOST_REPLIES = 4  # requests that are answered at once, beside the streams
_TOO_LONG = b"HTTP/1.0 431 Request Header Fields Too Large\r\nContent-Length: 0\r\n\r\n"
_LOCKED = "this page needs its whole address, as the terminal shows it, with what follows #"
ASSETS = {
    "index.html": "text/html; charset=utf-8",
    "style.css": "text/css; charset=utf-8",
    "icon.svg": "image/svg+xml",
    "main.js": "text/javascript; charset=utf-8",
    "channels.js": "text/javascript; charset=utf-8",
    "colours.js": "text/javascript; charset=utf-8",
    "controls.js": "text/javascript; charset=utf-8",
    "door.js": "text/javascript; charset=utf-8",
    "map.js": "text/javascript; charset=utf-8",
    "sensor.js": "text/javascript; charset=utf-8",
    "tasks.js": "text/javascript; charset=utf-8",
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


class Server:
    """Server of one page, with a bounded number of threads and connections.

    One thread reads requests. At most `MOST_CLIENTS` streams and `MOST_REPLIES` other answers are
    sent at once, each by a thread; other whole requests wait, up to a number.

    Attributes:
        files: content type and bytes of each file, by path.
        events: messages that `/events` streams.
        hello: the first event of each stream.
        commands: executes what is posted.
        access: who may see and command.
        port: listened at.
        watching: number of open streams.
    """

    def __init__(
        self,
        port: int,
        access: Access,
        events: Latest[bytes],
        hello: bytes,
        commands: PageCommands,
        limits: ClientLimits,
    ) -> None:
        """Take the port, 0 for any; raises ConfigurationError where it cannot be had."""
        folder = resources.files("eitskin.cli.page") / "web"
        self.files = {
            f"/{name}": (kind, (folder / name).read_bytes()) for name, kind in ASSETS.items()
        }
        self.files["/"] = self.files["/index.html"]
        self.access, self.events, self.hello = access, events, hello
        self.commands, self.limits = commands, limits
        self.watching = 0
        self._open: set[socket.socket] = set()
        self._lock = threading.Lock()
        listener = _listener(access.host, port)
        self.port: int = listener.getsockname()[1]
        self.cookie = f"eitskin-{self.port}"  # cookies of one name are shared by all ports
        self._workers = ThreadPoolExecutor(MOST_CLIENTS + MOST_REPLIES, "page request")
        self._arrivals = Arrivals(listener, self._take, limits.receive)

    @property
    def arriving(self) -> int:
        """Number of connections whose requests are not whole yet."""
        return self._arrivals.count

    def start(self) -> None:
        """Start to serve, in a thread."""
        self._arrivals.start()

    def close(self) -> None:
        """End every request and free the port."""
        self._arrivals.close()
        with self._lock:
            for connection in self._open:
                with suppress(OSError):  # the browser may be faster
                    connection.shutdown(socket.SHUT_RDWR)
        self._workers.shutdown()

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

    def _take(self, connection: socket.socket, request: bytes) -> None:
        """Answer a request when a thread is free; refuse it where too many wait."""
        with self._lock:
            room = len(self._open) < MOST_ARRIVING
            if room:
                self._open.add(connection)
        if room:
            self._workers.submit(self._answer, connection, request)
        else:
            connection.close()

    def _answer(self, connection: socket.socket, request: bytes) -> None:
        try:
            if not request:
                connection.settimeout(self.limits.send)
                connection.sendall(_TOO_LONG)
                return
            received = _Received(connection, request)
            _Handler(cast(Any, received), connection.getpeername(), cast(Any, self))
        except OSError:
            pass  # the browser has gone
        except Exception:
            log.exception("the page's server failed")
        finally:
            with self._lock:
                self._open.discard(connection)
            with suppress(OSError):  # what is left of an answer is still sent
                connection.shutdown(socket.SHUT_WR)
            connection.close()


def _listener(host: str, port: int) -> socket.socket:
    """Socket bound to an address of this machine; raises ConfigurationError where it cannot be."""
    family, address = resolved(host)
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((address, port))
    except (OSError, OverflowError) as error:
        listener.close()
        raise ConfigurationError(
            f"cannot serve the page at {host}, port {port}: {error}; choose another port, or 0 for "
            "any that is free, and an address of this machine"
        ) from error
    return listener


@dataclass(frozen=True, slots=True)
class _Received:
    """Connection with its whole request."""

    connection: socket.socket
    request: bytes


class _Sent(io.RawIOBase):
    """Writer that sends everything at once."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection

    def write(self, data: Any) -> int:
        self._connection.sendall(data)
        return len(data)


class _Handler(BaseHTTPRequestHandler):
    """Handler of one request; HTTP/1.0, so that each connection has one request."""

    server_version, sys_version = "eitskin", ""

    @property
    def page(self) -> Server:
        return cast(Server, self.server)

    def setup(self) -> None:
        received = cast(_Received, self.request)
        self.connection, limits = received.connection, self.page.limits
        self.connection.settimeout(limits.send)
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, limits.buffer)
        self.rfile = io.BytesIO(received.request)
        self.wfile = _Sent(self.connection)  # type: ignore[assignment]

    def finish(self) -> None:
        pass  # the server closes the connection

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        if self._refused(path):
            return
        if path == "/access":
            self._reply_json(HTTPStatus.OK, {"role": self._role.name.lower()})
        elif path == "/events":
            if self._allowed(Role.VIEWER):
                self._stream()
        elif path in self.page.files:
            self._reply(HTTPStatus.OK, *self.page.files[path])
        else:
            self._reply_error(HTTPStatus.NOT_FOUND, f"there is no {path} here")

    def do_POST(self) -> None:
        path = self.path.partition("?")[0]
        length = self.headers.get("Content-Length", "")
        body = self.rfile.read()
        if self._refused(path) or not (path == "/enter" or self._allowed(Role.COMMANDER)):
            return
        kind = self.headers.get("Content-Type", "").partition(";")[0].strip().lower()
        known = ("/enter", *self.page.commands.paths)
        if path not in known:
            self._reply_error(
                HTTPStatus.NOT_FOUND, f"expected a POST to {', '.join(known)}, got {path}"
            )
        elif kind != "application/json":
            self._reply_error(
                HTTPStatus.UNSUPPORTED_MEDIA_TYPE,
                f"expected Content-Type application/json, got {kind or 'none'}",
            )
        elif not (length.isascii() and length.isdigit() and len(length) < 10):
            self._reply_error(HTTPStatus.LENGTH_REQUIRED, "a command needs a Content-Length")
        elif len(body) > LARGEST_BODY:
            self._reply_error(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
                f"a command has at most {LARGEST_BODY} bytes, got {length}",
            )
        elif path == "/enter":
            self._enter(body)
        else:
            self._execute(path, body)

    def _execute(self, path: str, body: bytes) -> None:
        try:
            self.page.commands.execute(path, body)
        except ConflictError as error:
            self._reply_error(HTTPStatus.CONFLICT, str(error))
        except ConfigurationError as error:
            self._reply_error(HTTPStatus.BAD_REQUEST, str(error))
        else:
            self._reply_json(HTTPStatus.OK, {"done": True})

    def _enter(self, body: bytes) -> None:
        """Keep a token that was shown in a cookie, which scripts of no page can read."""
        try:
            token = entered(body)
        except ConfigurationError as error:
            self._reply_error(HTTPStatus.BAD_REQUEST, str(error))
            return
        role = self.page.access.role(token)
        if role is Role.STRANGER:
            self._reply_error(HTTPStatus.UNAUTHORIZED, _LOCKED)
            return
        cookie = f"{self.page.cookie}={token}; Path=/; HttpOnly; SameSite=Strict"
        answer = {"role": role.name.lower()}
        # Whoever needs no token has shown what may not be one, and gets no cookie of it.
        kept = {} if self.page.access.tokens is None else {"Set-Cookie": cookie}
        self._reply_json(HTTPStatus.OK, answer, kept)

    @property
    def _role(self) -> Role:
        """Role of who asks, by the token in a header or in the page's cookie."""
        scheme, _, token = self.headers.get("Authorization", "").partition(" ")
        if scheme.lower() == "bearer":
            return self.page.access.role(token.strip())
        try:
            kept = SimpleCookie(self.headers.get("Cookie", "")).get(self.page.cookie)
        except CookieError:
            kept = None
        return self.page.access.role(kept.value if kept else "")

    def _allowed(self, least: Role) -> bool:
        """Refuse who may not; whether the request goes on."""
        role = self._role
        if role is Role.STRANGER:
            self._reply_error(HTTPStatus.UNAUTHORIZED, _LOCKED)
        elif role < least:
            self._reply_error(
                HTTPStatus.FORBIDDEN, "this address only views; commands need the other"
            )
        return role >= least

    def _refused(self, path: str) -> bool:
        """Refuse a request that is not from this page itself; whether it was refused.

        A name that is none of this machine means that a foreign one was made to point here (DNS
        rebinding); an Origin other than the page's, that a foreign page asks.
        """
        host, origin = self.headers.get("Host", "").lower(), self.headers.get("Origin")
        site = self.headers.get("Sec-Fetch-Site", "none")
        names = self.page.access.names(self.connection.getsockname()[0])
        url = self.page.access.url(self.page.port)
        if host not in {f"{name}:{self.page.port}" for name in names}:
            wrong = f"this page is called {url}, not {host!r}"
        elif origin != f"http://{host}" and not (origin is None and self.command == "GET"):
            wrong = f"only the page at {url} may ask, not {origin or 'one without Origin'}"
        elif site not in ("none", "same-origin") and path != "/":
            wrong = f"only the page at {url} may ask, not a {site} one"
        else:
            return False
        self._reply_error(HTTPStatus.FORBIDDEN, wrong)
        return True

    def _stream(self) -> None:
        """Send each newest event until the browser disconnects or stalls."""
        if not self.page.admit():
            self._reply_error(
                HTTPStatus.SERVICE_UNAVAILABLE, f"{MOST_CLIENTS} browsers watch already"
            )
            return
        try:
            self.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            number = self.page.events.number
            self._head(HTTPStatus.OK, "text/event-stream", {})
            self.wfile.write(self.page.hello)
            while (newest := self.page.events.after(number)) is not None:
                number, message = newest
                self.wfile.write(message)
        except OSError:
            pass  # gone, or stalled for too long
        finally:
            self.page.dismiss()

    def _reply_error(self, status: HTTPStatus, message: str) -> None:
        self._reply_json(status, {"error": message})

    def _reply_json(
        self, status: HTTPStatus, data: dict[str, Any], headers: Mapping[str, str] | None = None
    ) -> None:
        body = json.dumps(data, separators=(",", ":")).encode()
        self._reply(status, "application/json", body, headers)

    def _reply(
        self, status: HTTPStatus, kind: str, body: bytes, headers: Mapping[str, str] | None = None
    ) -> None:
        self._head(status, kind, {"Content-Length": str(len(body))} | dict(headers or {}))
        self.wfile.write(body)

    def _head(self, status: HTTPStatus, kind: str, headers: Mapping[str, str]) -> None:
        self.send_response(status)
        for name, value in {"Content-Type": kind, **headers, **HEADERS}.items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        """Log nothing: the terminal shows the sensor."""
