"""The live page: what is sent, and to whom. No browser is needed."""

import contextlib
import dataclasses
import os
import socket
import stat
import threading
from contextlib import closing
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from eitskin.cli.page.drawing import Region
from eitskin.cli.page.live_page import LivePage, event
from eitskin.cli.page.server import KINDS, MAX_CLIENTS, ClientLimits
from eitskin.errors import ConfigurationError
from eitskin.hardware import Reading
from eitskin.simulator import Frame
from eitskin.training import TouchEstimate

from live_fakes import NOT_ESTIMATED, Estimate, Info
from page_fakes import DESIGN, PROTOCOL, FakeEstimate, Stream, ask, port_of, post, reading


@pytest.fixture
def many_beats(monkeypatch):
    monkeypatch.setattr("eitskin.cli.page.live_page.HEARTBEAT", 0.02)


@pytest.fixture
def stream(page):
    opened = Stream(page)
    yield opened
    opened.close()


def test_the_stream_begins_with_the_sensor_and_goes_on_with_frames(page, stream) -> None:
    assert stream.answer.headers["Content-Type"].startswith("text/event-stream")
    sensor = stream.until("sensor")
    assert sensor["labels"] == list(PROTOCOL.labels)
    assert len(sensor["electrodes"]) == 8
    assert len(sensor["shape"]["electrodes"]) == 8
    assert sensor["outline"] == [[0.0, 0.0], [0.15, 0.0], [0.15, 0.06], [0.0, 0.06]]
    assert "bit_flip" in sensor["controls"]["faults"]
    page.publish(reading(7))
    frame = stream.until("frame")
    assert (frame["number"], frame["lost"], frame["dropped"]) == (7, 2, {"crc": 1})
    assert not frame["stale"]
    estimate = frame["estimate"]
    assert (estimate["state"], estimate["angle"], estimate["deviation"]) == ("touch", 20.5, None)
    assert estimate["touches"] == [{"x": 0.05, "y": 0.031, "strength": 0.9, "force": 7.5}]
    assert frame["stage"]["truth"] == {
        "bend_deg": 20.0,
        "touches": [{"x": 0.05, "y": 0.03, "force": 10.0}],
    }


def test_a_sensor_of_unknown_geometry_is_a_rectangle_and_frames_know_when_they_began(connection):
    region = Region((-0.05, -0.04), (0.05, 0.06))
    connection.board.info = Info(period=float("nan"))
    with LivePage(connection, region) as page, closing(Stream(page)) as stream:
        assert page.max_age() == np.inf  # a board of unknown period is not called silent
        with pytest.raises(ConfigurationError, match="port "):
            LivePage(connection, region, port=port_of(page))
        sensor = stream.until("sensor")
        assert (sensor["origin"], sensor["electrodes"]) == ([-0.05, -0.04], [])
        assert (sensor["length"], sensor["width"]) == pytest.approx((0.1, 0.1))
        assert sensor["outline"] == [[-0.05, -0.04], [0.05, -0.04], [0.05, 0.06], [-0.05, 0.06]]
        assert sensor["thickness"] is sensor["shape"] is sensor["period"] is None
        assert post(page, "/scene", {"touches": [{"x": -0.04, "y": 0.0, "force": 8}]})[0] < 300
        status, answer = post(page, "/scene", {"touches": [{"x": 0.07, "y": 0.0, "force": 8}]})
        assert (status, "on the sensor" in answer["error"]) == (400, True)
    now = [50.0]
    with (
        LivePage(connection, DESIGN, clock=lambda: now[0]) as page,
        closing(Stream(page)) as stream,
    ):
        stream.until("sensor")
        page.publish(reading(1))
        assert stream.until("frame")["begun"] is None  # a board that tells no duration
        known = dataclasses.replace(reading(2).frame, duration=0.03, time=7.0)
        page.publish(dataclasses.replace(reading(2), frame=known, latency=0.004))
        assert stream.until("frame")["begun"] == pytest.approx(50.0 - 0.004 - 0.03)


@pytest.mark.usefixtures("many_beats")
def test_damaged_values_are_null_and_an_estimate_that_cannot_be_shown_is_not_the_end(
    page, stream, caplog
):
    impedance = np.full(28, 500.0 + 0j)
    impedance[3] = complex(np.nan, np.nan)
    touch_map = np.full((32, 80), np.nan)
    touch_map[1, 2] = 1.5
    estimate = FakeEstimate(
        bend_angle_deg=float("nan"),
        touch_map=touch_map,
        probabilities=(np.nan, 0.5, 0.5),
        touches=(TouchEstimate(0.05, 0.03, strength=0.5),),
    )
    page.publish(reading(1, estimate, impedance, rate=float("nan")))
    frame = stream.until("frame")  # the JSON of Python reads NaN; its writer here refuses to
    assert frame["channels"][3] is None
    assert frame["channels"][4] == 0.0
    assert frame["rate"] is frame["estimate"]["angle"] is None
    assert frame["estimate"]["touches"][0]["force"] is None
    with pytest.raises(ValueError, match="JSON"):
        event("frame", {"rate": float("nan")})
    page.publish(reading(estimate=Estimate(**NOT_ESTIMATED, probabilities=[np.nan])))
    estimate = stream.until("frame")["estimate"]
    assert estimate["probabilities"] == [None]
    assert {estimate[name] for name in ("state", "angle", "deviation", "map", "touches")} == {None}
    frame = Frame(np.full(28, 500.0), PROTOCOL, number=9, status=np.full(28, 8, np.uint8))
    page.publish(Reading(frame, None, 0.001, 30.0, 1, "too few good channels"))
    shown = stream.until("frame")
    assert shown["estimate"] is None
    assert shown["problem"] == "too few good channels"
    assert shown["bad"]["0-1"] == "open"
    page.publish(reading(1, estimate="not an estimate at all"))
    while not caplog.records:
        assert stream.until("health")
    page.publish(reading(2))
    assert stream.until("frame")["number"] == 2


def test_a_slow_browser_misses_frames_and_never_gets_old_ones(page, stream) -> None:
    stream.until("sensor")
    numbers = [0]
    for first in (1, 101, 201):
        for number in range(first, first + 100):
            page.publish(reading(number))
        while numbers[-1] != first + 99:
            numbers.append(stream.until("frame")["number"])
    assert numbers == sorted(set(numbers))
    assert len(numbers) < 300


def test_a_browser_that_comes_late_gets_the_past(connection) -> None:
    now = [0.0]
    with LivePage(connection, DESIGN, clock=lambda: now[0]) as page, closing(Stream(page)) as early:
        early.until("sensor")
        for number in range(1, 7):
            page.publish(reading(number))
            assert early.until("frame")["number"] == number
            now[0] += 0.15
        with closing(Stream(page)) as late:
            late.until("sensor")
            past = [late.next() for _ in range(3)]
            assert [(name, data["number"]) for name, data in past] == [
                ("past", n) for n in (1, 3, 5)
            ]
            assert [data["sent"] for _, data in past] == [0.0, 0.3, 0.6]
            page.publish(reading(7))
            assert late.until("frame")["number"] == 7


def test_a_browser_that_reads_nothing_is_dropped_and_delays_nobody(connection) -> None:
    with LivePage(connection, DESIGN, limits=ClientLimits(send=0.2, buffer=4096)) as page:
        stalled = socket.socket()
        stalled.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stalled.connect(("127.0.0.1", port_of(page)))
        stalled.sendall(f"GET /events HTTP/1.0\r\nHost: 127.0.0.1:{port_of(page)}\r\n\r\n".encode())
        stream = Stream(page)
        stream.until("sensor")
        served = page.server
        noisy = FakeEstimate(touch_map=np.random.default_rng(0).random((32, 80)))
        number = most = 0
        # Ends by the tests' limit of time, where the stalled one is never admitted or dropped.
        while most < 2 or served.watching > 1:
            most = max(most, served.watching)
            number += 1
            page.publish(reading(number, noisy))
            assert stream.until("frame")["number"] == number
        stream.close()
        stalled.close()


@pytest.mark.usefixtures("many_beats")
def test_silence_is_told(connection) -> None:
    now = [0.0]
    with LivePage(connection, DESIGN, clock=lambda: now[0]) as page:
        stream = Stream(page)
        stream.until("sensor")
        page.publish(reading(1))
        assert not stream.until("frame")["stale"]
        now[0] = 1.5
        connection.problem = "the board went away"
        connection.board.stage.inject("unplug")
        while not (health := stream.until("health"))["connection"]:
            pass
        assert health["stale"]
        assert health["age"] == 1.5
        assert health["connection"] == "the board went away"
        assert health["stage"]["faults"] == ["unplug"]
        stream.close()


def test_only_so_many_browsers_may_watch(page) -> None:
    streams = [Stream(page) for _ in range(MAX_CLIENTS)]
    for stream in streams:
        stream.until("sensor")
    assert ask(page, "GET", "/events")[0] == 503
    for stream in streams:
        stream.close()
    while page.server.watching:
        page.publish(reading(1))
    again = Stream(page)
    assert again.answer.status == 200
    again.close()


def sockets_at(port):
    count = 0
    for entry in Path("/dev/fd").iterdir():
        with contextlib.suppress(OSError):  # closed meanwhile
            if stat.S_ISSOCK(os.fstat(int(entry.name)).st_mode):
                with socket.socket(fileno=os.dup(int(entry.name))) as end:
                    count += end.family == socket.AF_INET and end.getsockname()[1] == port
    return count


def test_closing_leaves_nothing_behind(connection) -> None:
    threads = set(threading.enumerate())
    page = LivePage(connection, DESIGN, limits=ClientLimits(receive=1e4))
    streams = [Stream(page) for _ in range(3)]
    silent = socket.create_connection(("127.0.0.1", port_of(page)))
    for stream in streams:
        stream.until("sensor")
    port = port_of(page)
    assert sockets_at(port) > 3  # the one that listens, and one a stream
    page.close()
    page.close()
    assert set(threading.enumerate()) <= threads  # one of an earlier test may have ended
    for stream in streams:
        while stream.next() is not None:
            pass
        stream.close()
    silent.close()
    assert sockets_at(port) == 0
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", port))


def test_who_comes_while_a_page_closes_is_closed_with_it(connection, monkeypatch) -> None:
    page, resume = LivePage(connection, DESIGN), threading.Event()
    port, thread = port_of(page), page.server._thread
    page.server._loop.call_soon_threadsafe(resume.wait)
    with socket.create_connection(("127.0.0.1", port)):  # is accepted once the loop goes on
        join = thread.join
        monkeypatch.setattr(thread, "join", lambda: (resume.set(), join()))
        page.close()
        assert sockets_at(port) == 0


def test_every_asset_is_shipped_served_and_of_this_page_alone(page) -> None:
    folder = resources.files("eitskin.cli.page") / "web"
    for name in (entry.name for entry in folder.iterdir()):
        status, headers, body = ask(page, "GET", f"/{name}")
        assert status == 200
        assert headers["Content-Type"].partition(";")[0] == KINDS[Path(name).suffix]
        assert headers["Cache-Control"] == "no-store"
        assert headers["Content-Security-Policy"].startswith("default-src 'self';")
        assert body == (folder / name).read_bytes()
        text = body.decode().replace("http://www.w3.org/2000/svg", "")
        assert "http:" not in text  # nothing is loaded from elsewhere
        assert "https:" not in text
    index = (folder / "index.html").read_text()
    assert "style=" not in index  # which the policy forbids
    assert ask(page, "GET", "/")[2].decode() == index
    for path in ("/../page.py", "/page_http.py", "/%2e%2e/page.py"):
        assert ask(page, "GET", path)[0] == 404
