"""A board that the live page is of, and a browser that watches it."""

import http.client
import json
import threading
from contextlib import closing
from functools import partial

import numpy as np

from eitskin.cli.page.commands import ConflictError
from eitskin.errors import ConfigurationError
from eitskin.geometry import Bend, SensorDesign
from eitskin.hardware import Counts, Reading, Script, Stage, Step
from eitskin.simulator import Frame, Scene, Touch
from eitskin.training import TouchEstimate

from live_fakes import Estimate, FakeBoard, Info
from loopback import PROTOCOL, FakeSimulator

DESIGN = SensorDesign.reference()
JSON = {"Content-Type": "application/json"}


def solve(scene):
    """Impedance matrix of a scene, of which one is impossible."""
    if scene.bend.angle_deg == 13.0:
        raise ConfigurationError("expected a scene, got an unlucky one")
    return FakeSimulator().impedance_matrix(scene)


def staged_board(**changes):
    """A board with a stage, that has lost some frames; the 7th was of a bent, touched sensor."""
    stage = Stage(solve, Script((Step(Scene(Bend(20.0), (Touch(0.05, 0.03),))),)))
    stage.impedance_at_frame(0)
    stage.record_truth(7)
    stage.set(Scene())
    known = {"stage": stage, "uri": "virtual:", "info": Info(period=1 / 30)}
    return FakeBoard(**known | {"counts": Counts(frames=5, lost=2, dropped={"crc": 1})} | changes)


FakeEstimate = partial(
    Estimate, bend_angle_deg=20.5, touches=(TouchEstimate(0.05, 0.031, 7.5, strength=0.9),)
)


def reading(number=7, estimate=None, impedance=None, session=1, **known):
    impedance = np.full(28, 500.0 + number) if impedance is None else impedance
    frame = Frame(impedance, PROTOCOL, number=number, session=session)
    known = {"latency": 0.004, "rate": 30.0} | known
    return Reading(frame, estimate or FakeEstimate(), **known)


def port_of(page):
    return int(page.url.rstrip("/").rpartition(":")[2])


def ask(page, method, path, body=None, headers=None, own=True):
    """Status, headers and body of an answer; from the page's own origin unless sent otherwise."""
    client = http.client.HTTPConnection("127.0.0.1", port_of(page), timeout=300)
    own = {"Origin": page.url.rstrip("/")} if own and method == "POST" else {}
    with closing(client):
        client.request(method, path, body, own | (headers or {}))
        answer = client.getresponse()
        return answer.status, answer.headers, answer.read()


def post(page, path, data, **headers):
    """Status and parsed answer of a command."""
    body = data if isinstance(data, bytes) else json.dumps(data).encode()
    status, _, answer = ask(page, "POST", path, body, JSON | headers)
    return status, json.loads(answer)


class Stream:
    """A browser's event source."""

    def __init__(self, page, headers=None):
        self.client = http.client.HTTPConnection("127.0.0.1", port_of(page), timeout=300)
        self.client.request("GET", "/events", headers=headers or {})
        self.answer = self.client.getresponse()

    def next(self):
        """Name and data of the next event; None at the end."""
        fields = {}
        while line := self.answer.readline().decode():
            name, colon, value = line.rstrip("\n").partition(": ")
            if not name:
                return fields["event"], json.loads(fields["data"])
            assert colon
            assert name in ("retry", "event", "data")
            fields[name] = value
        return None

    def until(self, name):
        """Data of the next event of that name."""
        while (found := self.next())[0] != name:
            pass
        return found[1]

    def close(self):
        self.answer.close()
        self.client.close()


class FakeSession:
    """Remembers what it was asked for, and has the state that the test wants."""

    def __init__(self):
        self.asked, self.task, self.busy = [], None, False
        self.came = threading.Event()
        paths = ("/tare", "/check", "/record", "/setup", "/answer", "/cancel")
        self.commands = {path: partial(self.execute, path) for path in paths}
        self.commands["/replay"] = lambda _: json.dumps({"readings": self.readings}).encode()
        self.readings = []

    def execute(self, path, body):
        if self.busy:
            raise ConflictError("check is not finished")
        self.asked.append((path, body.decode()))
        self.came.set()

    def state(self):
        none = {"recording": None, "recorded": "", "recordings": ["monday"]}
        return {"task": self.task, **none}

    def pressed(self):
        """The next command; ends by the tests' limit of time where none comes."""
        self.came.wait()
        self.came.clear()
        return self.asked.pop(0)
