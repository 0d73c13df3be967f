"""HTTP server of the live page: files, events and commands, for those who may have them."""

import asyncio
import logging
import socket
import threading
from collections import Counter, deque
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from importlib import resources
from pathlib import PurePath
from typing import Any

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import Receive, Scope, Send
from uvicorn import Config
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from eitskin.cli.page.access import Access, Role, resolve_host
from eitskin.cli.page.commands import Commands, ConflictError, read_arguments
from eitskin.errors import ConfigurationError

MAX_CLIENTS = 8
MAX_REPLIES = 4  # commands that are executed at once
MAX_ARRIVING = 64  # connections whose requests are not whole yet
MAX_HEAD = 16384  # bytes
MAX_BODY = 4096  # bytes
MAX_PAST = 3000  # frames that a browser which comes late gets: ten minutes, five a second
_BACKLOG = 128
_ADDRESS_MESSAGE = (
    "this page needs its whole address, as the terminal shows it, with what follows #"
)
KINDS = {
    ".html": "text/html",
    ".css": "text/css",
    ".js": "text/javascript",
    ".svg": "image/svg+xml",
}
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Connection": "close",
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
    """Server of one page, in a thread of its own, with a bounded number of connections.

    Attributes:
        files: name and content of each file.
        hello: the first event of each stream.
        commands: functions of posted bodies, by path.
        access: who may see and command.
        port: listened at.
        watching: number of open streams.
        arriving: connections whose requests are not whole yet, oldest first, and their addresses.
    """

    def __init__(
        self, port: int, access: Access, hello: bytes, commands: Commands, limits: ClientLimits
    ) -> None:
        """Take the port, 0 for any, and serve; raises ConfigurationError where it cannot be had."""
        folder = resources.files("eitskin.cli.page") / "web"
        self.files = {entry.name: entry.read_bytes() for entry in folder.iterdir()}
        self.access, self.hello, self.commands, self.limits = access, hello, commands, limits
        self.watching = 0
        self.arriving: dict[_Connection, str] = {}
        listener = _listener(access.host, port)
        self.port: int = listener.getsockname()[1]
        self.cookie = f"eitskin-{self.port}"  # cookies of one name are shared by all ports
        self._newest, self._number = b"", 0
        self._past: deque[bytes] = deque(maxlen=MAX_PAST)
        self._changed, self._closed = asyncio.Event(), asyncio.Event()
        self._workers = ThreadPoolExecutor(MAX_REPLIES, "page command")
        self._routes = Starlette(
            routes=[
                Route("/access", self._show_role),
                Route("/events", self._stream),
                Route("/enter", self._enter, methods=["POST"]),
                *(Route(path, self._execute, methods=["POST"]) for path in commands),
                Route("/{name}", self._show_file),
                Route("/", self._show_file),
            ],
            exception_handlers=dict.fromkeys(
                (HTTPException, ConfigurationError, ClientDisconnect), _refuse
            ),
        )
        self._loop = asyncio.SelectorEventLoop()
        self._thread = threading.Thread(
            target=self._run, args=(listener,), name="page server", daemon=True
        )
        self._thread.start()

    def send(self, message: bytes, memorable: bool = False) -> None:
        """Make this event the next one of all streams, a memorable one part of their past.

        Returns at once.
        """
        self._loop.call_soon_threadsafe(self._replace, message, memorable)

    def close(self) -> None:
        """End every request and free the port."""
        self._loop.call_soon_threadsafe(self._closed.set)
        self._thread.join()
        self._workers.shutdown()

    def make_room(self) -> None:
        """Close the oldest arriving connection of the address that has most of them."""
        most = Counter(self.arriving.values()).most_common(1)[0][0]
        oldest = next(each for each, address in self.arriving.items() if address == most)
        del self.arriving[oldest]
        oldest.transport.abort()

    def _run(self, listener: socket.socket) -> None:
        try:
            self._loop.run_until_complete(self._serve(listener))
        finally:
            self._loop.close()

    async def _serve(self, listener: socket.socket) -> None:
        """Serve until the page is closed; then streams end, and commands are waited for."""
        config = Config(
            self,
            http=_Connection,
            ws="none",
            interface="asgi3",
            log_config=None,
            log_level=logging.ERROR,
            access_log=False,  # the terminal shows the sensor
            headers=list(HEADERS.items()),
            limit_concurrency=2 * MAX_ARRIVING,
            h11_max_incomplete_event_size=MAX_HEAD,
        )
        config.load()
        state = ServerState()
        state.default_headers = config.encoded_headers
        opened = partial(_Connection, config, state, {"page": self}, self._loop)
        server = await self._loop.create_server(opened, sock=listener, backlog=_BACKLOG)
        await self._closed.wait()
        self._loop.remove_reader(listener)
        await asyncio.sleep(0)  # who was just accepted is refused, and lost, by a closed server
        server.close()
        self._changed.set()
        for arriving in list(self.arriving):
            arriving.transport.abort()
        # Requests, and connections that are being opened.
        if tasks := asyncio.all_tasks() - {asyncio.current_task()}:
            await asyncio.wait(tasks, timeout=self.limits.send)
        for connection in list(state.connections):
            connection.transport.abort()
        await server.wait_closed()

    def _replace(self, message: bytes, memorable: bool) -> None:
        self._newest, self._number = message, self._number + 1
        if memorable:
            self._past.append(message.replace(b"frame", b"past", 1))
        self._changed.set()
        self._changed = asyncio.Event()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, unless another page sends it."""
        wrong = self._foreign(Request(scope))
        answer = JSONResponse({"error": wrong}, 403) if wrong else self._routes
        await answer(scope, receive, send)

    def _foreign(self, request: Request) -> str:
        """Reason why a request is not from this page itself; empty for its own.

        A name that is none of this machine means that a foreign one was made to point here (DNS
        rebinding); an Origin other than the page's, that a foreign page asks.
        """
        headers = request.headers
        host, origin = headers.get("Host", "").lower(), headers.get("Origin")
        site = headers.get("Sec-Fetch-Site", "none")
        names = self.access.names(request.scope["server"][0])
        url = self.access.url(self.port)
        if host not in {f"{name}:{self.port}" for name in names}:
            return f"this page is called {url}, not {host!r}"
        if origin != f"http://{host}" and not (origin is None and request.method == "GET"):
            return f"only the page at {url} may ask, not {origin or 'one without Origin'}"
        if site not in ("none", "same-origin") and request.scope["path"] != "/":
            return f"only the page at {url} may ask, not a {site} one"
        return ""

    def _role(self, request: Request) -> Role:
        """Role of who asks, by the token in a header or in the page's cookie."""
        scheme, _, token = request.headers.get("Authorization", "").partition(" ")
        if scheme.lower() == "bearer":
            return self.access.role(token.strip())
        return self.access.role(request.cookies.get(self.cookie, ""))

    def _require(self, request: Request, min_role: Role) -> None:
        """Refuse who may not."""
        role = self._role(request)
        if role is Role.STRANGER:
            raise HTTPException(401, _ADDRESS_MESSAGE)
        if role < min_role:
            raise HTTPException(403, "this address only views; commands need the other")

    async def _show_role(self, request: Request) -> Response:
        return JSONResponse({"role": self._role(request).name.lower()})

    async def _show_file(self, request: Request) -> Response:
        name = request.path_params.get("name", "index.html")
        if name not in self.files:
            raise HTTPException(404, f"there is no /{name} here")
        return Response(self.files[name], media_type=KINDS[PurePath(name).suffix])

    async def _stream(self, request: Request) -> Response:
        self._require(request, Role.VIEWER)
        if self.watching >= MAX_CLIENTS:
            raise HTTPException(503, f"{MAX_CLIENTS} browsers watch already")
        return _Stream(self)

    async def events(self) -> AsyncIterator[bytes]:
        """Events of a stream: the first, the past, then the newest each time, until the end."""
        number = self._number
        yield self.hello
        for message in tuple(self._past):
            yield message
        while not self._closed.is_set():
            if self._number == number:
                await self._changed.wait()
            else:
                number = self._number
                yield self._newest

    async def _execute(self, request: Request) -> Response:
        self._require(request, Role.COMMANDER)
        path, body = request.url.path, await _body(request)
        answer = await self._loop.run_in_executor(self._workers, self.commands[path], body)
        return Response(answer or b'{"done":true}', media_type="application/json")

    async def _enter(self, request: Request) -> Response:
        """Keep a token that was shown in a cookie, which scripts of no page can read."""
        asked = read_arguments(self.access.role, "/enter", await _body(request))
        role, token = self.access.role(**asked), asked["token"]
        if role is Role.STRANGER:
            raise HTTPException(401, _ADDRESS_MESSAGE)
        cookie = f"{self.cookie}={token}; Path=/; HttpOnly; SameSite=Strict"
        # Whoever needs no token has shown what may not be one, and gets no cookie of it.
        headers = {} if self.access.tokens is None else {"Set-Cookie": cookie}
        return JSONResponse({"role": role.name.lower()}, headers=headers)


class _Stream(StreamingResponse):
    """Server-sent events, counted while they are sent."""

    def __init__(self, server: Server) -> None:
        super().__init__(server.events(), media_type="text/event-stream")
        self._server = server

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        self._server.watching += 1
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._server.watching -= 1


class _Connection(H11Protocol):
    """Connection of one request, with deadlines for the request and for a browser that stalls."""

    _timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._page: Server = self.app_state["page"]
        limits, arriving = self._page.limits, self._page.arriving
        transport.set_write_buffer_limits(0)  # no old frames
        transport.get_extra_info("socket").setsockopt(
            socket.SOL_SOCKET, socket.SO_SNDBUF, limits.buffer
        )
        if len(arriving) >= MAX_ARRIVING:
            self._page.make_room()
        arriving[self] = transport.get_extra_info("peername")[0]
        self._schedule_abort(limits.receive)

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if self.cycle is not None and not self.cycle.more_body and self in self._page.arriving:
            del self._page.arriving[self]
            self._schedule_abort(None)

    def pause_writing(self) -> None:
        super().pause_writing()
        self._schedule_abort(self._page.limits.send)

    def resume_writing(self) -> None:
        super().resume_writing()
        self._schedule_abort(None)

    def connection_lost(self, exc: Exception | None) -> None:
        self._page.arriving.pop(self, None)
        self._schedule_abort(None)
        super().connection_lost(exc)

    def _schedule_abort(self, seconds: float | None) -> None:
        """Disconnect after this time; None, or another call meanwhile, calls it off."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None if seconds is None else self.loop.call_later(seconds, self._abort)

    def _abort(self) -> None:
        self.transport.abort()


async def _body(request: Request) -> bytes:
    """Body of a command; raises HTTPException for one that is too long or of another kind."""
    kind = request.headers.get("Content-Type", "").partition(";")[0].strip().lower()
    if kind != "application/json":
        raise HTTPException(415, f"expected Content-Type application/json, got {kind or 'none'}")
    if "Content-Length" not in request.headers:
        raise HTTPException(411, "a command needs a Content-Length")
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > MAX_BODY:
            raise HTTPException(413, f"a command has at most {MAX_BODY} bytes")
    return body


async def _refuse(_: Request, error: Any) -> Response:
    """Refusal in words."""
    if isinstance(error, HTTPException):
        return JSONResponse({"error": error.detail}, error.status_code)
    return JSONResponse({"error": str(error)}, 409 if isinstance(error, ConflictError) else 400)


def _listener(host: str, port: int) -> socket.socket:
    """Socket that listens at an address of this machine.

    Raises ConfigurationError where it cannot be had.
    """
    family, address = resolve_host(host)
    try:
        return socket.create_server((address, port), family=family, backlog=_BACKLOG)
    except (OSError, OverflowError) as error:
        raise ConfigurationError(
            f"cannot serve the page at {host}, port {port}: {error}; choose another port, or 0 for "
            "any that is free, and an address of this machine"
        ) from error
