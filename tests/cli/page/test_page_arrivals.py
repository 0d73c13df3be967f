"""The live page: connections that send slowly, nothing, or too much."""

import socket
import threading
from contextlib import ExitStack, closing

import pytest

from eitskin.cli.page.arrivals import (
    LARGEST_BODY,
    LARGEST_HEAD,
    MOST_ARRIVING,
    Arrivals,
    Incoming,
)
from eitskin.cli.page.live_page import LivePage
from eitskin.cli.page.server import MOST_CLIENTS, MOST_REPLIES, ClientLimits

from page_fakes import DESIGN, Stream, ask, port_of

REQUEST = b"POST /scene HTTP/1.0\r\nHost: a\r\ncontent-LENGTH: 5\r\n\r\n12345"


def whole_request(data):
    """The request in bytes that come at once; one byte after the other they give the same."""
    found, incoming = Incoming().add(data), Incoming()
    single = (incoming.add(data[k : k + 1]) for k in range(len(data)))
    first = next((each for each in single if each is not None), None)
    assert first == found
    return found


def test_a_request_is_whole_at_its_last_byte():
    for end in range(len(REQUEST)):
        assert whole_request(REQUEST[:end]) is None
    assert whole_request(REQUEST + b"more") == REQUEST
    assert whole_request(b"GET / HTTP/1.0\n\nrest") == b"GET / HTTP/1.0\n\n"


def test_a_request_without_an_end_is_cut():
    assert whole_request(b"G" * LARGEST_HEAD) == b""
    assert whole_request(b"G" * (LARGEST_HEAD - 1)) is None
    head = b"POST / HTTP/1.0\r\nContent-Length: 999999999\r\n\r\n"
    assert whole_request(head + b"x" * LARGEST_BODY) is None
    assert len(whole_request(head + b"x" * 9999)) == len(head) + LARGEST_BODY + 1
    # A length that is none, or in the body, counts as none.
    for wrong in (b"-1", b"1e9", b"99999999999", b"x"):
        head = b"POST / HTTP/1.0\r\nContent-Length: " + wrong + b"\r\n\r\n"
        assert whole_request(head) == head
    assert whole_request(b"GET / HTTP/1.0\r\n\r\nContent-Length: 9\r\n\r\n").endswith(b"\r\n\r\n")


def connected(page):
    return socket.create_connection(("127.0.0.1", port_of(page)), timeout=10)


def ended(client):
    """Whether the server ends a connection; waits for it."""
    try:
        return client.recv(1) == b""
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


def test_trickling_bytes_do_not_put_the_deadline_off():
    """A clock that is moved by hand: a byte in time is read, one at the deadline too late."""
    now, listener = [0.0], socket.create_server(("127.0.0.1", 0))
    arrivals = Arrivals(listener, pytest.fail, 10.0, clock=lambda: now[0])
    arrivals.start()
    with closing(arrivals), closing(socket.create_connection(listener.getsockname())) as client:
        client.sendall(b"GET / HTTP/1.0\r\n")
        while not arrivals.count:
            pass
        for now[0] in (3.0, 6.0, 9.0, 9.9):
            client.sendall(b"x")
            assert arrivals.count == 1
        now[0] = 10.0
        client.sendall(b"x")
        assert ended(client)
        assert arrivals.count == 0


def test_a_head_without_end_is_refused(page):
    with closing(connected(page)) as client:
        client.sendall(b"GET /" + b"x" * LARGEST_HEAD)
        assert client.recv(100).startswith(b"HTTP/1.0 431")


def test_threads_and_connections_are_bounded_whatever_comes(connection):
    """Half requests that will never be whole: others get answers all the same."""
    before = threading.active_count()
    patient = ClientLimits(receive=1e4)
    with LivePage(connection, DESIGN, limits=patient) as page, ExitStack() as stack:
        for _ in range(5 * MOST_ARRIVING):
            client = stack.enter_context(closing(connected(page)))
            client.sendall(b"GET / HTTP/1.0\r\n")
        assert ask(page, "GET", "/")[0] == 200
        assert page.server.arriving <= MOST_ARRIVING
        stream = stack.enter_context(closing(Stream(page)))
        assert stream.until("sensor")["length"] == 0.15
        assert threading.active_count() - before <= 2 + MOST_CLIENTS + MOST_REPLIES


def test_more_streams_than_may_watch_leave_threads_for_other_requests(page):
    with ExitStack() as stack:
        streams = [stack.enter_context(closing(Stream(page))) for _ in range(3 * MOST_CLIENTS)]
        assert [each.answer.status for each in streams].count(200) == MOST_CLIENTS
        assert ask(page, "GET", "/style.css")[0] == 200


def test_a_browser_that_goes_before_its_answer_does_no_harm(page):
    for _ in range(20):
        with closing(connected(page)) as client:
            client.sendall(b"GET /main.js HTTP/1.0\r\n\r\n")
    assert ask(page, "GET", "/")[0] == 200
