"""The live page: who may see and command it, what it may be asked, and slow or silent requests."""

import json
import logging
import os
import re
import socket
import threading
from contextlib import ExitStack, closing, suppress

import pytest

from eitskin.cli.page.access import Access, Role, Tokens
from eitskin.cli.page.live_page import LivePage
from eitskin.cli.page.server import (
    MAX_ARRIVING,
    MAX_BODY,
    MAX_CLIENTS,
    MAX_HEAD,
    MAX_REPLIES,
    ClientLimits,
)
from eitskin.errors import ConfigurationError
from eitskin.geometry import Bend
from eitskin.hardware import Connection
from eitskin.simulator import Scene, Touch

from page_fakes import (
    DESIGN,
    JSON,
    FakeSession,
    Stream,
    ask,
    port_of,
    post,
    reading,
    staged_board,
)


@pytest.fixture(scope="module")
def unchanged():
    """The connection of `refusing`."""
    return Connection(staged_board())


@pytest.fixture(scope="module")
def refusing(unchanged):
    """A page for many requests that change nothing."""
    with LivePage(unchanged, DESIGN) as made:
        yield made


@pytest.mark.slow
@pytest.mark.parametrize("path", ["/", "/events"])
@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:1"},
        {"Host": "evil.example"},
        {"Host": "127.0.0.1"},
        {"Host": "evil.example:80", "Origin": "http://evil.example:80"},
    ],
)
def test_foreign_pages_are_refused(refusing, path, headers) -> None:
    status, _, body = ask(refusing, "GET", path, headers=headers)
    assert status == 403
    assert "this page is called" in (error := json.loads(body)["error"]) or "only the page" in error


def test_foreign_pages_may_link_and_neither_embed_nor_command(page, connection):
    foreign = {"Sec-Fetch-Site": "cross-site"}
    assert ask(page, "GET", "/events", headers=foreign)[0] == 403
    assert ask(page, "GET", "/", headers=foreign)[0] == 200
    body = json.dumps({"bend_deg": 5}).encode()
    assert ask(page, "POST", "/scene", body, JSON, own=False)[0] == 403
    assert ask(page, "POST", "/scene", body, JSON | {"Origin": "http://evil.example"})[0] == 403
    assert ask(page, "POST", "/scene", body, {"Content-Type": "text/plain"})[0] == 415
    assert ask(page, "POST", "/elsewhere", body, JSON)[0] == 405
    assert ask(page, "POST", "/scene", b" " * (MAX_BODY + 1), JSON)[0] == 413
    assert ask(page, "POST", "/scene", None, JSON | {"Content-Length": "-1"})[0] == 400
    assert ask(page, "PUT", "/scene", body, JSON)[0] == 403
    assert connection.board.stage.scene == Scene()


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost"])
def test_its_own_names_and_origins_are_served(page, connection, name) -> None:
    own = f"{name}:{port_of(page)}"
    assert ask(page, "GET", "/", headers={"Host": own})[0] == 200
    headers = {"Host": own, "Origin": f"http://{own}"}
    assert ask(page, "GET", "/style.css", headers=headers)[0] == 200
    touches = [{"x": 0.05, "y": 0.03, "force": 4}, {"x": 0.1, "y": 0.02, "force": 8.5}]
    wanted = {"bend_deg": -12.5, "touches": touches}
    assert post(page, "/scene", wanted, **headers) == (200, {"done": True})
    pressed = (Touch(0.05, 0.03, 4.0), Touch(0.1, 0.02, 8.5))
    assert connection.board.stage.scene == Scene(Bend(-12.5), pressed)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"{", "expected JSON"),
        (b'{"bend_deg": NaN}', "expected JSON"),
        ([1], r"JSON object.*list"),
        ({"bend": 3}, "did you mean|'bend'"),
        ({"bend_deg": "3"}, "bend_deg"),
        ({"bend_deg": 61}, r"bend_deg.*-30 to 60.*61"),
        ({"touches": [{"x": 0.2, "y": 0.03, "force": 5}]}, "sensor"),
        ({"touches": [{"x": 0.1, "y": 0.03, "force": 99}]}, r"force.*1 to 12.*99"),
        (
            {"touches": [{"x": 0.01 + 0.03 * i, "y": 0.03, "force": 5} for i in range(5)]},
            r"4 touches.*5",
        ),
        (
            {"touches": [{"x": x, "y": 0.03, "force": 5} for x in (0.05, 0.051)]},
            "their indenters need",
        ),
        ({"bend_deg": 13}, "an unlucky one"),
    ],
)
def test_what_cannot_be_a_scene_is_refused_in_words(refusing, unchanged, data, message) -> None:
    stage = unchanged.board.stage
    status, answer = post(refusing, "/scene", data)
    assert status == 400
    assert re.search(message, answer["error"])
    assert stage.scene == Scene()


def angle_at(stage, frame):
    """Bend angle in a frame to come [deg]."""
    stage.impedance_at_frame(frame)
    stage.record_truth(frame)
    return stage.truth(frame).bend.angle_deg


def test_faults_and_episodes_begin_and_end(page, connection):
    stage = connection.board.stage
    assert post(page, "/fault", {"fault": "bit_flip:12"})[0] == 200
    for fault in ("tea:1", "bit_flip@3,unplug"):
        assert post(page, "/fault", {"fault": fault})[0] == 400
    for data in ({}, {"fault": "bit_flip", "clear": True}):
        assert post(page, "/fault", data)[0] == 400
    assert stage.faults == ("bit_flip:12",)
    assert post(page, "/fault", {"clear": True})[0] == 200
    assert stage.faults == ()
    assert post(page, "/play", {"play": True})[0] == 200
    frames = (89, 90, 180, 270)  # steps of three seconds
    assert [angle_at(stage, frame) for frame in frames] == [0.0, -10.0, -10.0, 20.0]
    assert post(page, "/play", {"play": False})[0] == 200
    assert angle_at(stage, 90) == 0.0
    assert post(page, "/play", {"play": 1})[0] == 400


def test_a_real_board_cannot_be_commanded() -> None:
    with LivePage(Connection(staged_board(stage=None, uri="serial:/dev/x")), DESIGN) as page:
        for path, data in (("/scene", {}), ("/fault", {"clear": True}), ("/play", {"play": True})):
            assert post(page, path, data)[0] == 409
        stream = Stream(page)
        assert stream.until("sensor")["controls"] is None
        page.publish(reading(1))
        assert stream.until("frame")["stage"] is None
        stream.close()


TOKENS = Tokens("view-" + 12 * "v", "command-" + 12 * "c")


@pytest.fixture
def guarded(connection):
    """A page that needs a token."""
    with LivePage(connection, DESIGN, access=Access(tokens=TOKENS)) as made:
        yield made


def bearer(token):
    return {"Authorization": f"Bearer {token}"}


def role_of(page, headers):
    return json.loads(ask(page, "GET", "/access", headers=headers)[2])["role"]


def entering(page, token):
    """Status of a token that is shown, and the cookie that is kept of it."""
    body = json.dumps({"token": token}).encode()
    status, headers, _ = ask(page, "POST", "/enter", body, JSON)
    return status, headers.get("Set-Cookie", "")


@pytest.mark.parametrize(
    ("token", "role", "status"), [("view", "viewer", 403), ("command", "commander", 200)]
)
def test_each_token_does_what_it_is_for(guarded, connection, token, role, status):
    """A stranger gets the empty page and nothing of the sensor, a foreign page nothing at all."""
    for headers in ({}, bearer("wrong"), {"Cookie": f"{guarded.server.cookie}=wrong"}):
        assert ask(guarded, "GET", "/", headers=headers)[0] == 200
        assert role_of(guarded, headers) == "stranger"
        assert ask(guarded, "GET", "/events", headers=headers)[0] == 401
        assert post(guarded, "/scene", {"bend_deg": 7}, **headers)[0] == 401
    secret = getattr(TOKENS, token)
    entered, cookie = entering(guarded, secret)
    assert entered == 200
    kept, *facts = cookie.split("; ")
    assert {"HttpOnly", "SameSite=Strict", "Path=/"} == set(facts)
    for headers in ({"Cookie": f"other=1; {kept}"}, bearer(secret)):
        assert role_of(guarded, headers) == role
        assert post(guarded, "/scene", {"bend_deg": 5}, **headers)[0] == status
        with closing(Stream(guarded, headers)) as stream:
            assert stream.until("sensor")["length"] == 0.15
        foreign = headers | {"Origin": "http://evil.example"}
        assert post(guarded, "/scene", {"bend_deg": 7}, **foreign)[0] == 403
        assert ask(guarded, "POST", "/scene", b"{}", JSON | headers, own=False)[0] == 403
    assert connection.board.stage.scene == (Scene(Bend(5.0)) if status == 200 else Scene())


def test_the_session_is_asked_by_who_may_command_and_a_wrong_token_is_kept_nowhere(
    connection, guarded, caplog
):
    session = FakeSession()
    with LivePage(connection, DESIGN, access=Access(tokens=TOKENS), session=session) as page:
        own = bearer(TOKENS.command)
        assert post(page, "/tare", {}, **bearer(TOKENS.view))[0] == 403
        assert post(page, "/tare", {})[0] == 401
        assert session.asked == []
        assert post(page, "/tare", {}, **own) == (200, {"done": True})
        assert session.asked == [("/tare", "{}")]
        session.busy = True
        assert post(page, "/check", {}, **own) == (409, {"error": "check is not finished"})
        with closing(Stream(page, own)) as stream:
            assert stream.until("sensor")["tasks"] == list(session.commands)
            session.task = {"progress": "working"}
            page.tell()
            assert stream.until("health")["tasks"]["task"] == session.task
    caplog.set_level(logging.DEBUG)
    for token in ("", "wrong", TOKENS.view[:-1], TOKENS.view + "x", "\N{SNOWMAN}"):
        assert entering(guarded, token) == (401, "")
    assert ask(guarded, "POST", "/enter", b"[]", JSON)[0] == 400
    entering(guarded, TOKENS.command)
    assert TOKENS.command not in caplog.text
    assert TOKENS.command not in repr(TOKENS)


def test_every_network_needs_tokens_which_the_addresses_have():
    for host in ("127.0.0.1", "localhost", "127.0.0.5"):
        assert Access.for_host(host).tokens is None
        assert Access.for_host(host).role("") is Role.COMMANDER
    access = Access.for_host("0.0.0.0")  # noqa: S104
    (_, view), (_, command) = access.invitations(8940)
    assert access.role(view.partition("#")[2]) is Role.VIEWER
    assert access.role(command.partition("#")[2]) is Role.COMMANDER
    assert "0.0.0.0" not in view  # noqa: S104
    assert Access.for_host("0.0.0.0").tokens != access.tokens  # noqa: S104
    # Requests may call the page by the address that they came to.
    for came_to in ("192.168.1.5", "::ffff:192.168.1.5"):
        assert {"192.168.1.5", "192.168.1.6"} & access.names(came_to) == {"192.168.1.5"}
    assert "[fe80::1]" in access.names("fe80::1%eth0")


def test_tokens_are_kept_in_a_file_that_only_its_owner_reads_and_others_refused(tmp_path):
    path = tmp_path / "tokens"
    made = Access.for_host("127.0.0.1", path)
    assert made.tokens is not None
    assert path.stat().st_mode & 0o777 == 0o600
    assert Access.for_host("0.0.0.0", path).tokens == made.tokens  # noqa: S104
    path.chmod(0o640)
    with pytest.raises(ConfigurationError, match="chmod 600"):
        Tokens.load_or_create(path)
    path, known = tmp_path / "tokens", "0123456789abcdef"
    path.touch(0o600)
    texts = ("", "view short\ncommand short", f"view {known}", f"view {known}\ncommand {known}")
    for text in (*texts, f"view {known} {known}", "\x00" * 99, "x" * 5000):
        path.write_text(text)
        with pytest.raises(ConfigurationError, match="expected"):
            Tokens.load_or_create(path)
    os.mkfifo(tmp_path / "pipe")  # which is not waited for
    with pytest.raises(ConfigurationError, match="something else"):
        Tokens.load_or_create(tmp_path / "pipe")


REQUEST = b"POST /scene HTTP/1.0\r\nHost: a\r\ncontent-LENGTH: 5\r\n\r\n12345"


def connected(page):
    return socket.create_connection(("127.0.0.1", port_of(page)), timeout=300)


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


def test_half_a_request_is_disconnected_and_trickling_bytes_do_not_put_that_off(hasty):
    for sent in (b"", b"G", b"GET / HTTP/1.0\r\nHost: a\r\n", REQUEST[:-1]):
        with closing(connected(hasty)) as client:
            client.sendall(sent)
            assert ended(client)
    with closing(connected(hasty)) as client:
        client.sendall(b"GET / HTTP/1.0\r\n")
        with suppress(ConnectionError):
            for _ in range(10_000):
                client.sendall(b"x")
        assert ended(client)


def test_head_and_body_are_read_up_to_their_limits(page):
    host = f"127.0.0.1:{port_of(page)}"
    head = f"POST /scene HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\n"
    head += "Content-Type: application/json\r\nContent-Length: 999999999\r\n\r\n"
    for sent, status in (
        (b"GET /" + b"x" * 2 * MAX_HEAD, b"HTTP/1.1 400"),
        (head.encode() + b"x" * (MAX_BODY + 1), b"HTTP/1.1 413"),
    ):
        with closing(connected(page)) as client:
            client.sendall(sent)
            assert client.recv(100).startswith(status)


@pytest.mark.slow
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
