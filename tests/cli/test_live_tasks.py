"""Tasks of a live session: a new zero, the sensor check, recordings, and the set-up."""

import json
import re
import threading
import types
from functools import lru_cache
from itertools import count

import numpy as np
import pytest
from rich.console import Console

from eitskin import training
from eitskin.cli.commands.live.session import LiveSession
from eitskin.cli.commands.live.tasks import Progress, SessionTasks, Task
from eitskin.cli.options import Output
from eitskin.cli.page.commands import ConflictError
from eitskin.datasets import open_dataset
from eitskin.errors import ConfigurationError, DataError
from eitskin.geometry import SensorDesign
from eitskin.hardware import Connection, Reading, open_board, run_live
from eitskin.hardware.virtual import virtual_board
from eitskin.latest import Latest
from eitskin.simulator import Frame, Simulator
from eitskin.training import Pipeline

from live_fakes import PROTOCOL, Estimate, FakeBoard, FakePipeline, run_command

OHM = np.linspace(400.0, 820.0, 28)


class TaredPipeline(FakePipeline):
    """Remembers the thread that tared it, and may find the sensor moving."""

    moves, tared_by = False, None

    def tare(self, frames, *_):
        if self.moves:
            raise DataError("expected frames of a still sensor")
        self.tared_by = threading.current_thread()
        return types.SimpleNamespace(zero="flat", frames=len(frames))


class Running:
    """A session whose readings come as often as they are asked for."""

    def __init__(self, folder, pipeline):
        output = Output(quiet=True, notes=Console(width=200))
        self.session = LiveSession(Connection(FakeBoard()), output, pipeline)
        self.numbers, self.bad = count(), []
        self.tasks = SessionTasks(self.session, folder, "fake.eitmodel")

    def ask(self, path, **body):
        self.tasks.commands[path](json.dumps(body).encode())

    def take(self):
        number = next(self.numbers)
        noise = 1e-4 * np.random.default_rng(number).standard_normal(28)
        ohm = np.where(np.isin(np.arange(28), self.bad), 300.0, OHM * (1.0 + noise))
        shown = Frame(ohm, PROTOCOL, 0.3 * number, number)
        self.session.take(Reading(shown, Estimate(), 0.001, 3.0))

    @property
    def task(self):
        return self.tasks.state()["task"]

    def finish(self):
        """Last state of the task, with as many readings as that needs."""
        while not self.task["over"]:
            self.take()
        return self.task["progress"], self.task["text"]


@pytest.fixture
def pipeline():
    return TaredPipeline()


@pytest.fixture
def running(tmp_path, pipeline):
    made = Running(tmp_path / "files", pipeline)
    with made.tasks:
        yield made


@pytest.mark.slow
def test_the_loop_tares_with_enough_frames_and_the_check_says_what_the_command_would(
    running, pipeline
):
    running.ask("/tare")
    assert running.task["progress"] == "working"
    progress, text = running.finish()
    assert (progress, text) == ("done", "zero: the sensor flat, mean of 32 frames")
    assert pipeline.tared_by is threading.current_thread()
    pipeline.moves = True
    running.ask("/tare")
    assert running.finish() == ("failed", "expected frames of a still sensor")
    running.ask("/check")
    assert running.finish() == ("done", "healthy: no fault in 16 frames")
    assert "no redundant measurements" in running.task["lines"][0]
    running.bad = [0, 1, 2]
    running.ask("/check")
    progress, text = running.finish()
    assert progress == "done"
    assert "healthy" not in text


def test_one_task_at_a_time_which_can_be_cancelled(running):
    for path in ("/cancel", "/answer"):
        with pytest.raises(ConflictError):
            running.ask(path, **({"answer": ""} if path == "/answer" else {}))
    running.ask("/check")
    with pytest.raises(ConflictError, match="check is not finished"):
        running.ask("/tare")
    running.ask("/cancel")
    assert running.finish()[0] == "cancelled"
    running.ask("/tare")
    assert running.finish()[0] == "done"


@pytest.mark.slow
def test_frames_are_recorded_between_two_commands_and_replayed(running, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "open_pipeline", lambda *_: running.session.pipeline)
    running.session.pipeline.layout = types.SimpleNamespace(known_design=SensorDesign.reference())
    running.take()
    running.ask("/record", record=True)
    for _ in range(5):
        running.take()
    recording = running.tasks.state()["recording"]
    assert (recording["frames"], recording["problem"]) == (5, "")
    with pytest.raises(ConflictError):
        running.ask("/record", record=True)
    running.ask("/record", record=False)
    running.take()
    assert len(open_dataset(recording["folder"])) == 5
    (name,) = running.tasks.state()["recordings"]
    answer = json.loads(running.tasks.commands["/replay"](json.dumps({"name": name}).encode()))
    assert [each["time"] for each in answer["readings"]] == pytest.approx([0.0, 0.3, 0.6, 0.9, 1.2])
    with pytest.raises(ConfigurationError, match="no recording"):
        running.ask("/replay", name="../other")
    assert running.tasks.state()["recording"] is None
    assert running.tasks.state()["recorded"].endswith("5 frames")
    with pytest.raises(ConflictError):
        running.ask("/record", record=False)
    running.ask("/record", record=True)  # in one second, perhaps, and until the session ends
    running.take()
    running.ask("/check")
    running.tasks.close()
    assert running.task["progress"] == "cancelled"
    (_, last) = sorted((tmp_path / "files").iterdir(), key=lambda path: path.stat().st_mtime)
    assert len(open_dataset(last)) == 1


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("/record", {}),
        ("/record", {"record": 1}),
        ("/answer", {"answer": 3}),
        ("/tare", {"frames": 3}),
        ("/setup", {"presses": -1}),
        ("/setup", {"frames": 10**9}),
        ("/setup", {"angles": "ten"}),
    ],
)
def test_other_commands_are_refused(running, path, body):
    with pytest.raises(ConfigurationError):
        running.ask(path, **body)
    assert running.task is None


def test_only_answers_that_are_offered_count():
    task = Task("set up", Latest(), lambda: None)
    assert not task.answer("")
    thread = threading.Thread(
        target=task.run, args=(lambda task: task.ask("well?", {"": "yes", "s": "no"}, (0.1, 0.2)),)
    )
    thread.start()
    while task.state.progress is not Progress.ASKING:
        pass
    assert task.state.place == (0.1, 0.2)
    assert not task.answer("r")
    assert task.answer("s")
    assert not task.answer("s")
    thread.join()
    assert (task.state.progress, task.state.text, task.state.place) == (Progress.DONE, "s", None)


@pytest.mark.slow
def test_a_virtual_sensor_is_set_up_from_the_page(tmp_path, monkeypatch):
    """The steps of the command, with frames of a session that goes on meanwhile."""
    monkeypatch.setattr(virtual_board, "Simulator", lru_cache(Simulator))
    pipeline = Pipeline.load("reference.eitmodel")
    with open_board("virtual:?speed=max") as board:
        session = LiveSession(Connection(board), Output(quiet=True), pipeline)
        with SessionTasks(session, tmp_path, "reference.eitmodel") as tasks:
            tasks.commands["/setup"](b'{"angles": "25", "presses": 2, "frames": 3}')
            asked = []
            for reading in run_live(session.connection, session):
                session.take(reading)
                task = tasks.state()["task"]
                if task["over"]:
                    break
                if task["progress"] == "asking":
                    asked.append(re.split(r":| in ", task["text"])[0])
                    begun = task["text"].startswith("check: is")
                    tasks.commands["/answer"](b'{"answer": "s"}' if begun else b'{"answer": ""}')
    assert task["progress"] == "done", task
    (saved,) = tmp_path.glob("*.eitmodel")
    assert asked == [
        "check",
        "zero",
        "zero",
        "angles",
        "angles",
        "presses",
        "presses",
        "use the new pipeline",
    ]
    assert Pipeline.load(saved).adaptation["bends"] == 3
    assert session.pipeline is not pipeline  # which the answer wanted
    assert str(session.stored_reference.zero) == "flat"
    assert f"eitskin live {saved}" in task["text"]
    assert [each.suffix for each in sorted(tmp_path.iterdir())].count(".json") == 1


@pytest.mark.parametrize("quiet", [(), ("-q",)])
def test_addresses_with_tokens_are_told_once_and_whole(monkeypatch, tmp_path, quiet):
    pipeline = FakePipeline()
    pipeline.layout.known_design = SensorDesign.reference()
    served = ("--page", "--page-port", "0", "--page-token-file", str(tmp_path / "tokens"))
    board = ("--board", "virtual:?speed=max", "--frames", "2")
    ran = run_command(monkeypatch, pipeline, *board, *served, *quiet)
    assert ran.exit_code == 0, ran.output
    for line in (tmp_path / "tokens").read_text().splitlines():
        (told,) = [each for each in ran.stderr.splitlines() if line.split()[1] in each]
        assert f"/#{line.split()[1]}" in told
