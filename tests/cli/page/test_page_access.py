"""The live page: who may see it and who may command it."""

import json
import logging
import os
from contextlib import closing
from pathlib import Path

import pytest

from eitskin.cli.page.access import Access, Role, Tokens
from eitskin.cli.page.live_page import LivePage
from eitskin.errors import ConfigurationError
from eitskin.geometry import Bend
from eitskin.simulator import Scene

from page_fakes import DESIGN, JSON, FakeSession, Stream, ask, post

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


def test_a_stranger_gets_the_empty_page_and_nothing_of_the_sensor(guarded, connection):
    for headers in ({}, bearer("wrong"), {"Cookie": f"{guarded.server.cookie}=wrong"}):
        assert ask(guarded, "GET", "/", headers=headers)[0] == 200
        assert role_of(guarded, headers) == "stranger"
        assert ask(guarded, "GET", "/events", headers=headers)[0] == 401
        assert post(guarded, "/scene", {"bend_deg": 5}, **headers)[0] == 401
    assert connection.board.stage.scene == Scene()


@pytest.mark.parametrize(
    ("token", "role", "status"), [("view", "viewer", 403), ("command", "commander", 200)]
)
def test_each_token_does_what_it_is_for(guarded, connection, token, role, status):
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
    assert connection.board.stage.scene == (Scene(Bend(5.0)) if status == 200 else Scene())


def test_the_session_is_asked_by_who_may_command(connection):
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


def test_a_wrong_token_is_kept_nowhere(guarded, caplog):
    caplog.set_level(logging.DEBUG)
    for token in ("", "wrong", TOKENS.view[:-1], TOKENS.view + "x", "\N{SNOWMAN}"):
        assert entering(guarded, token) == (401, "")
    assert ask(guarded, "POST", "/enter", b"[]", JSON)[0] == 400
    entering(guarded, TOKENS.command)
    assert TOKENS.command not in caplog.text
    assert TOKENS.command not in repr(TOKENS)


def test_a_token_does_not_help_a_foreign_page(guarded):
    own = bearer(TOKENS.command)
    foreign = {"Origin": "http://evil.example"}
    assert post(guarded, "/scene", {"bend_deg": 5}, **own, **foreign)[0] == 403
    assert ask(guarded, "GET", "/events", headers=own | {"Host": "evil.example"})[0] == 403
    assert ask(guarded, "POST", "/scene", b"{}", JSON | own, own=False)[0] == 403


def test_without_tokens_everybody_on_this_machine_may_command(page):
    assert role_of(page, {}) == "commander"
    assert entering(page, "anything") == (200, "")


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "127.0.0.5"])
def test_this_machine_needs_no_token(host):
    assert Access.of(host).tokens is None
    ((_, url),) = Access.of(host).invitations(80)
    assert url == f"http://{host}:80/"


def test_every_network_needs_tokens_which_the_addresses_have():
    access = Access.of("0.0.0.0")  # noqa: S104
    (_, view), (_, command) = access.invitations(8940)
    assert access.role(view.partition("#")[2]) is Role.VIEWER
    assert access.role(command.partition("#")[2]) is Role.COMMANDER
    assert "0.0.0.0" not in view  # noqa: S104
    assert Access.of("0.0.0.0").tokens != access.tokens  # noqa: S104


def test_requests_may_call_the_page_by_the_address_that_they_came_to():
    access = Access("0.0.0.0", TOKENS)  # noqa: S104
    assert "192.168.1.5" in access.names("192.168.1.5")
    assert "192.168.1.5" in access.names("::ffff:192.168.1.5")
    assert "[fe80::1]" in access.names("fe80::1%eth0")
    assert "192.168.1.6" not in access.names("192.168.1.5")
    assert "localhost" not in access.names("192.168.1.5")


@pytest.mark.parametrize("host", ["no-such-host.invalid", "", "a" * 70, "203.0.113.1"])
def test_a_host_that_is_not_this_machine_is_refused(host, connection):
    with pytest.raises(ConfigurationError, match=r"address|expected"):
        LivePage(connection, DESIGN, access=Access.of(host))


def test_tokens_are_kept_in_a_file_that_only_its_owner_reads(tmp_path):
    path = tmp_path / "tokens"
    made = Access.of("127.0.0.1", path)
    assert made.tokens is not None
    assert path.stat().st_mode & 0o777 == 0o600
    assert Access.of("0.0.0.0", path).tokens == made.tokens  # noqa: S104
    path.chmod(0o640)
    with pytest.raises(ConfigurationError, match="chmod 600"):
        Tokens.kept(path)


def test_other_files_are_no_tokens(tmp_path):
    path, known = tmp_path / "tokens", "0123456789abcdef"
    path.touch(0o600)
    texts = ("", "view short\ncommand short", f"view {known}", f"view {known}\ncommand {known}")
    for text in (*texts, f"view {known} {known}", "\x00" * 99, "x" * 5000):
        path.write_text(text)
        with pytest.raises(ConfigurationError, match="expected"):
            Tokens.kept(path)


def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ConfigurationError, match="something else"):
        Tokens.kept(tmp_path / "pipe")
    with pytest.raises(ConfigurationError, match="cannot write"):
        Tokens.kept(Path("/no/such/folder/tokens"))
