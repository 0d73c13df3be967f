"""Streams: records by UDP and WebSocket, and clients that are slow or vanish."""

import json
import re
import shlex
import shutil
import socket
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from eitskin.errors import ConfigurationError
from eitskin.hardware import Connection, Reading, streams
from eitskin.training import FoundTouches

from live_fakes import NOT_ESTIMATED, Estimate, FakeBoard, frame

CLIENTS = Path(__file__).parents[2] / "docs" / "clients"
DOCS = Path(__file__).parents[2] / "docs"


def reading(number=0, **changes):
    return Reading(frame(number), Estimate(**changes), 0.001, 3.0, wall_time=1.7e9)


@pytest.fixture
def listener():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("127.0.0.1", 0))
        opened.settimeout(300.0)
        yield opened


@pytest.fixture
def udp(listener):
    outlet = streams.UdpOutlet(*listener.getsockname())
    yield outlet
    outlet.close()


@pytest.fixture
def served():
    outlet = streams.WebSocketOutlet("127.0.0.1", 0)
    yield outlet
    outlet.close()


# Records


def test_the_page_lists_every_key_in_its_order():
    section = re.split(r"^## ", (DOCS / "reference" / "live.md").read_text(), flags=re.M)[2]
    rows = re.findall(r"`(\w+)`", "".join(re.findall(r"^\| (`.*?`) \|", section, re.MULTILINE)))
    found = FoundTouches.from_arrays([[0.05, 0.02]], [0.9], [np.nan], [1e-3])
    record = streams.reading_record(reading(touches=tuple(found)), FakeBoard.counts)
    (touch,) = record["touches"]
    assert (touch["force"], touch["deviation"]) == (None, 1e-3)
    assert rows == [*record, *touch]
    assert all(f"`{key}`" in section for key in ("seconds", "problem"))


# UDP


def test_each_reading_is_one_datagram_and_silence_is_told(listener, udp):
    connection = Connection(FakeBoard())
    connection.problem = "the cable is out"
    with streams.ReadingPublisher(connection, [udp], heartbeat=0.02) as publisher:
        publisher.publish(reading(7))
        while (said := json.loads(listener.recv(65536)))["kind"] == "silence":
            pass  # of a busy machine, before the reading
        assert said == streams.reading_record(reading(7), FakeBoard.counts)
        silent = json.loads(listener.recv(65536))
        assert (silent["kind"], silent["problem"]) == ("silence", "the cable is out")
        assert silent["seconds"] >= 0.02


def test_nobody_listening_and_messages_too_long_are_no_error(udp, listener):
    listener.close()
    for _ in range(3):
        udp.send("{}")
    udp.send("x" * 70_000)
    assert udp.refused == 1


@pytest.mark.parametrize(
    ("text", "address"),
    [("5005", ("127.0.0.1", 5005)), ("robot:1", ("robot", 1)), ("[::1]:9", ("::1", 9))],
)
def test_an_address_is_of_this_machine_unless_it_says_so(text, address):
    assert streams.parse_address("--udp", text) == address


# WebSocket


def test_a_client_that_reads_late_gets_the_newest_after_a_few_old_ones(served):
    with connect(served.url, max_queue=1) as late, connect(served.url) as lively:
        for number in range(200):
            served.send(str(number))
            assert lively.recv(300.0) == str(number)
        got = [late.recv(300.0)]
        while got[-1] != "199":
            got.append(late.recv(300.0))
        assert len(got) < 10


@pytest.mark.slow
def test_a_client_that_reads_nothing_holds_nobody_up_and_is_let_go(served, monkeypatch):
    monkeypatch.setattr("eitskin.hardware.streams.STALL_TIMEOUT", 0.5)
    big = "x" * 2**20
    with ExitStack() as stack:
        stalled = stack.enter_context(connect(served.url, max_queue=1, max_size=None))
        (stuck,) = served._server.handler_threads
        lively = stack.enter_context(connect(served.url, max_size=None))
        for _ in range(1000):  # how much the system keeps for a client that reads nothing differs
            served.send(big)
            assert len(lively.recv(300.0)) == 2**20
            stuck.join(0.005)
            if not stuck.is_alive():
                break
        assert not stuck.is_alive()
        stalled.socket.close()


def test_a_client_that_vanishes_frees_its_seat_and_one_too_many_is_told(served):
    with ExitStack() as stack:
        clients = [stack.enter_context(connect(served.url)) for _ in range(streams.MAX_CLIENTS)]
        served.send("1")
        assert [client.recv(300.0) for client in clients] == ["1"] * streams.MAX_CLIENTS
        late = stack.enter_context(connect(served.url))
        with pytest.raises(ConnectionClosed) as closed:
            late.recv(300.0)
        assert closed.value.rcvd.code == 1013
        for client in clients:
            client.socket.shutdown(socket.SHUT_RDWR)
        while threads := list(served._server.handler_threads):  # each notices when it next sends
            served.send("2")
            threads[0].join(0.01)
        served.send("3")
        again = stack.enter_context(connect(served.url))
        assert again.recv(300.0) == "3"


def test_foreign_pages_may_not_listen_and_a_port_in_use_is_refused(served, listener):
    for origin in ("http://127.0.0.1:8000", "http://localhost"):
        with connect(served.url, origin=origin):
            pass
    for origin in ("http://evil.example", "http://127.0.0.1.evil.example", "null"):
        with pytest.raises(InvalidStatus, match="403"), connect(served.url, origin=origin):
            pass
    port, connection = served.url.rpartition(":")[2].strip("/"), Connection(FakeBoard())
    with pytest.raises(ConfigurationError, match=port):
        streams.open_publisher(connection, str(listener.getsockname()[1]), port)


def test_both_outlets_send_the_same(listener):
    udp = str(listener.getsockname()[1])
    with streams.open_publisher(Connection(FakeBoard()), udp, "0") as publisher:
        publisher.publish(reading(7))
        assert publisher.addresses[0] == f"udp://127.0.0.1:{udp}"
        with connect(publisher.addresses[1]) as client:
            assert json.loads(client.recv(300.0))["version"] == 1
        assert json.loads(listener.recv(65536))["number"] == 7


# Clients


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler here")
    program = tmp_path_factory.mktemp("clients") / "listen"
    strict = ["-std=c11", "-Wall", "-Wextra", "-Werror", "-pedantic"]
    subprocess.run([compiler, *strict, "-o", program, CLIENTS / "listen.c", "-lm"], check=True)
    return [str(program)]


def messages():
    tricky = ('an electrode is "open": "state": "bend", {[',)
    found = FoundTouches.from_arrays([[0.05, 0.02], [0.1, 0.03]], [0.9, 0.5], [7.5, np.nan])
    two = Estimate(touches=tuple(found))
    none = Estimate(**NOT_ESTIMATED | {"bend_angle_deg": np.nan}, probabilities=3 * (np.nan,))
    none = replace(none, problems=tricky)
    each = (
        reading(touches=()),
        Reading(frame(4), two, 0.1, 3.0),
        Reading(frame(5), none, 0.1, 3.0),
    )
    yield from (streams.reading_record(reading, FakeBoard.counts) for reading in each)
    yield streams.reading_record(
        Reading(frame(6), None, 0.1, 3.0, 1, "all are open"), FakeBoard.counts
    )
    yield {"version": 2, "kind": "reading"}
    yield streams.silence_record(3.2, "the cable is out")


SHOWN = [
    "0: touch, -12.5 deg",
    "4: touch, -12.5 deg, touch at (50.0, 20.0) mm with 7.5 N"
    ", touch at (100.0, 30.0) mm with nan N",
    "5: unknown, nan deg",
    "6: unknown, nan deg",
    "nothing for 3 s",
]


@pytest.mark.parametrize("language", ["C", "Python"])
def test_the_clients_of_the_page_read_every_record(language, request):
    python = [sys.executable, str(CLIENTS / "listen.py")]
    command = request.getfixturevalue("compiled") if language == "C" else python
    sent = [json.dumps(each) for each in messages()]
    with subprocess.Popen(
        [*command, "0", str(len(sent))], stdout=subprocess.PIPE, text=True
    ) as client:
        port = int(client.stdout.readline().split()[-1])
        outlet = streams.UdpOutlet("127.0.0.1", port)
        for message in sent:
            outlet.send(message)
        outlet.close()
        lines = client.stdout.read().replace("+nan", "nan").splitlines()
    assert (client.returncode, lines) == (0, SHOWN)


def test_lines_and_service_of_the_page_are_those_of_this_command(served, capsys):
    (lines,) = re.findall(
        r"```python\n(import json\n.*?)```", (DOCS / "how-to" / "robot.md").read_text(), re.DOTALL
    )
    for number in range(2):
        served.send(json.dumps({"kind": "reading", "state": "idle", "number": number}))
    lines = lines.replace("ws://127.0.0.1:8941/", served.url)
    exec(lines + "        break\n", {})  # noqa: S102
    assert capsys.readouterr().out == "reading idle\n"
    text = (CLIENTS / "eitskin-live.service").read_text()
    program, *arguments = shlex.split(re.search("^ExecStart=(.*)$", text, re.MULTILINE)[1])
    assert program.endswith("/eitskin")
    known = re.findall(r"--[\w-]+", run("live", "--help").output)
    assert {each for each in arguments if each.startswith("--")} <= {*known}
