"""The live page: what it may be asked, and by whom."""

import json
import re

import pytest

from eitskin.cli.page.live_page import LivePage
from eitskin.cli.page.server import MAX_BODY
from eitskin.geometry import Bend
from eitskin.simulator import Scene, Touch

from page_fakes import DESIGN, JSON, FakeBoard, FakeConnection, Stream, ask, port_of, post, reading


@pytest.fixture(scope="module")
def unchanged():
    """The connection of `refusing`."""
    return FakeConnection()


@pytest.fixture(scope="module")
def refusing(unchanged):
    """A page for many requests that change nothing."""
    with LivePage(unchanged, DESIGN) as made:
        yield made


@pytest.mark.parametrize("path", ["/", "/main.js", "/events", "/nothing"])
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


def test_a_foreign_page_may_not_embed_but_may_link(page) -> None:
    foreign = {"Sec-Fetch-Site": "cross-site"}
    assert ask(page, "GET", "/events", headers=foreign)[0] == 403
    assert ask(page, "GET", "/", headers=foreign)[0] == 200


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost"])
def test_its_own_names_and_origins_are_served(page, connection, name) -> None:
    own = f"{name}:{port_of(page)}"
    assert ask(page, "GET", "/", headers={"Host": own})[0] == 200
    headers = {"Host": own, "Origin": f"http://{own}"}
    assert ask(page, "GET", "/style.css", headers=headers)[0] == 200
    assert post(page, "/scene", {"bend_deg": 5}, **headers)[0] == 200
    assert connection.board.stage.scene == Scene(Bend(5.0))


def test_commands_need_the_pages_origin_and_json(page, connection) -> None:
    body = json.dumps({"bend_deg": 5}).encode()
    assert ask(page, "POST", "/scene", body, JSON, own=False)[0] == 403
    assert ask(page, "POST", "/scene", body, JSON | {"Origin": "http://evil.example"})[0] == 403
    assert ask(page, "POST", "/scene", body, {"Content-Type": "text/plain"})[0] == 415
    assert ask(page, "POST", "/elsewhere", body, JSON)[0] == 405
    assert ask(page, "POST", "/scene", b" " * (MAX_BODY + 1), JSON)[0] == 413
    assert ask(page, "POST", "/scene", None, JSON | {"Content-Length": "-1"})[0] == 400
    assert ask(page, "PUT", "/scene", body, JSON)[0] == 403
    assert connection.board.stage.scene == Scene()


def test_a_scene_is_set(page, connection) -> None:
    touches = [{"x": 0.05, "y": 0.03, "force": 4}, {"x": 0.1, "y": 0.02, "force": 8.5}]
    assert post(page, "/scene", {"bend_deg": -12.5, "touches": touches}) == (200, {"done": True})
    wanted = Scene(Bend(-12.5), (Touch(0.05, 0.03, 4.0), Touch(0.1, 0.02, 8.5)))
    assert connection.board.stage.scene == wanted


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"{", "expected JSON"),
        (b'{"bend_deg": NaN}', "expected JSON"),
        (b"[" * 4000, "expected JSON"),
        ([1], r"JSON object.*list"),
        ({"bend": 3}, "did you mean|'bend'"),
        ({"bend_deg": "3"}, "bend_deg"),
        ({"bend_deg": 61}, r"bend_deg.*-30 to 60.*61"),
        ({"touches": [{"x": 0.2, "y": 0.03, "force": 5}]}, "sensor"),
        ({"touches": [{"x": 0.1, "y": 0.03, "force": 99}]}, r"force.*1 to 12.*99"),
        ({"touches": [{"x": 0.1, "y": 0.03}]}, "missing required field `force`"),
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


def test_faults_are_injected_and_ended(page, connection) -> None:
    stage = connection.board.stage
    assert post(page, "/fault", {"fault": "bit_flip:12"})[0] == 200
    assert stage.faults == ("bit_flip:12",)
    for data, message in (
        ({"fault": "tea:1"}, "no fault tea:1"),
        ({"fault": "bit_flip@3,unplug"}, "name or name:index"),
        ({}, 'give either "fault"'),
        ({"fault": "bit_flip", "clear": True}, 'give either "fault"'),
    ):
        status, answer = post(page, "/fault", data)
        assert status == 400
        assert message in answer["error"]
    assert post(page, "/fault", {"clear": True})[0] == 200
    assert stage.faults == ()


def test_the_episode_is_played_and_ended(page, connection) -> None:
    stage = connection.board.stage
    assert post(page, "/play", {"play": True})[0] == 200
    (script,) = stage.played
    assert script.steps[0].frames == 90  # three seconds
    assert [step.scene.bend.angle_deg for step in script.steps][:4] == [0.0, -10.0, -10.0, 20.0]
    stage.scene = Scene(Bend(40.0))
    assert post(page, "/play", {"play": False})[0] == 200
    assert stage.scene == Scene()
    assert post(page, "/play", {"play": 1})[0] == 400


def test_a_real_board_cannot_be_commanded() -> None:
    with LivePage(FakeConnection(FakeBoard(stage=None, uri="serial:/dev/x")), DESIGN) as page:
        for path, data in (("/scene", {}), ("/fault", {"clear": True}), ("/play", {"play": True})):
            status, answer = post(page, path, data)
            assert status == 409
            assert "not a virtual one" in answer["error"]
        stream = Stream(page)
        assert stream.until("sensor")["controls"] is None
        page.publish(reading(1))
        assert stream.until("frame")["stage"] is None
        stream.close()
