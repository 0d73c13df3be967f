"""The live page: connections that send slowly, nothing, or too much."""

import socket
import threading
from contextlib import ExitStack, closing, suppress

import pytest

from eitskin.cli.page.live_page import LivePage
from eitskin.cli.page.server import (
    MAX_ARRIVING,
    MAX_BODY,
    MAX_CLIENTS,
    MAX_HEAD,
    MAX_REPLIES,
    ClientLimits,
)

from page_fakes import DESIGN, Stream, ask, port_of

REQUEST = b"POST /scene HTTP/1.0\r\nHost: a\r\ncontent-LENGTH: 5\r\n\r\n12345"


def connected(page):
    return socket.create_connection(("127.0.0.1", port_of(page)), timeout=10)


def ended(client):
    """Whether the server ends a connection; waits for it."""
    try:
        while client.recv(1024):  # of a refusal
            pass
        return True
    except ConnectionError:
        return True


@pytest.fixture
def hasty(connection):
    """A page that waits a twentieth of a second for a request."""
    with LivePage(connection, DESIGN, limits=ClientLimits(receive=0.05)) as made:
        yield made


def test_who_sends_nothing_or_half_a_request_is_disconnected(hasty):
    for sent in (b"", b"G", b"GET / HTTP/1.0\r\nHost: a\r\n", REQUEST[:-1]):
        with closing(connected(hasty)) as client:
            client.sendall(sent)
            assert ended(client)


def test_trickling_bytes_do_not_put_the_deadline_off(hasty):
    with closing(connected(hasty)) as client:
        client.sendall(b"GET / HTTP/1.0\r\n")
        with suppress(ConnectionError):
            for _ in range(10_000):
                client.sendall(b"x")
        assert ended(client)


def test_a_body_is_read_up_to_its_limit(page):
    with closing(connected(page)) as client:
        host = f"127.0.0.1:{port_of(page)}"
        head = f"POST /scene HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\n"
        head += "Content-Type: application/json\r\nContent-Length: 999999999\r\n\r\n"
        client.sendall(head.encode() + b"x" * (MAX_BODY + 1))
        assert client.recv(100).startswith(b"HTTP/1.1 413")


def test_a_head_without_end_is_refused(page):
    with closing(connected(page)) as client:
        client.sendall(b"GET /" + b"x" * 2 * MAX_HEAD)
        assert client.recv(100).startswith(b"HTTP/1.1 400")


def test_threads_and_connections_are_bounded_whatever_comes(connection):
    """Half requests that will never be whole: others get answers all the same."""
    before = threading.active_count()
    patient = ClientLimits(receive=1e4)
    with LivePage(connection, DESIGN, limits=patient) as page, ExitStack() as stack:
        for _ in range(5 * MAX_ARRIVING):
            client = stack.enter_context(closing(connected(page)))
            client.sendall(b"GET / HTTP/1.0\r\n")
        assert ask(page, "GET", "/")[0] == 200
        assert len(page.server.arriving) <= MAX_ARRIVING
        stream = stack.enter_context(closing(Stream(page)))
        assert stream.until("sensor")["length"] == 0.15
        assert threading.active_count() - before <= 2 + MAX_CLIENTS + MAX_REPLIES


def test_more_streams_than_may_watch_leave_threads_for_other_requests(page):
    with ExitStack() as stack:
        streams = [stack.enter_context(closing(Stream(page))) for _ in range(3 * MAX_CLIENTS)]
        assert [each.answer.status for each in streams].count(200) == MAX_CLIENTS
        assert ask(page, "GET", "/style.css")[0] == 200


def test_a_browser_that_goes_before_its_answer_does_no_harm(page):
    for _ in range(20):
        with closing(connected(page)) as client:
            client.sendall(b"GET /main.js HTTP/1.0\r\n\r\n")
    assert ask(page, "GET", "/")[0] == 200
