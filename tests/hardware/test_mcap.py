"""Recordings and readings as MCAP: read back by rosbags, equal to the last bit."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
from command_line import printed_json
from mcap_reader import read

from eitskin.datasets import ShardWriter, State, open_dataset
from eitskin.errors import ConfigurationError
from eitskin.hardware import Reading
from eitskin.hardware.ros2.messages import GAP, NAME, TOUCH_FIELDS, McapWriter, RosMessages, Stamps
from eitskin.simulator import Frame, Protocol, Status
from eitskin.training import TouchEstimate

from live_fakes import NOT_ESTIMATED, Estimate
from small_dataset import make

UNKNOWN = math.nan


def values_of(message, name):
    """Level, message and values of one status of a DiagnosticArray."""
    status = next(each for each in message.status if each.name == name)
    return status.level, status.message, {pair.key: pair.value for pair in status.values}


def rows_of(points):
    """Touches of a PointCloud2, (k, fields)."""
    return points.data.view("<f4").reshape(points.width, len(TOUCH_FIELDS))


def a_frame(time=0.0, session=0, number=0):
    return Frame(np.arange(28) + 1j, Protocol.pairwise(8), time, number, session)


def written(path, *readings):
    with McapWriter(path) as writer:
        for reading in readings:
            writer.write(reading)
    return read(path)


# Written messages


@pytest.mark.slow
def test_frames_come_back_to_the_last_bit(tmp_path) -> None:
    data = make(20)
    frames = [data.frame(i) for i in range(len(data))]
    lost = np.where(np.arange(28) == 3, np.nan, frames[7].impedance)
    status = np.where(np.arange(28) == 3, Status.NOT_FINITE, 0).astype(np.uint8)
    frames[7] = dataclasses.replace(frames[7], impedance=lost, status=status)
    path = tmp_path / "run.mcap"
    found = written(path, *(Reading(frame, None, UNKNOWN, UNKNOWN) for frame in frames))
    assert [each.name for each in tmp_path.iterdir()] == ["run.mcap"]
    assert set(found) == {"/eitskin/sensor", "/eitskin/impedance", "/diagnostics"}
    assert len(found["/eitskin/impedance"]) == len(frames)
    pairs = zip(frames, found["/eitskin/impedance"], found["/diagnostics"], strict=True)
    for frame, (stamp, impedance), (_, diagnostics) in pairs:
        assert np.asarray(impedance.data).tobytes() == frame.impedance.tobytes()
        assert [(d.size, d.stride) for d in impedance.layout.dim] == [(28, 56), (2, 2)]
        header = diagnostics.header
        assert header.stamp.sec * 10**9 + header.stamp.nanosec == stamp
        assert header.frame_id == NAME
        _, _, about = values_of(diagnostics, "eitskin: sensor")
        assert float(about["time [s]"]) == frame.time
        assert (int(about["session"]), int(about["number"])) == (frame.session, frame.number)
        assert "latency [s]" not in about
        _, _, channels = values_of(diagnostics, "eitskin: channels")
        assert tuple(channels) == frame.protocol.labels
    level, text, channels = values_of(found["/diagnostics"][7][1], "eitskin: channels")
    assert (level, text, channels["0-4"]) == (1, "1 of 28 channels are bad", "NOT_FINITE")
    about = [json.loads(message.data) for _, message in found["/eitskin/sensor"]]
    assert len(about) == 2  # one for each session
    assert about[0]["protocol"]["table"] == [list(row) for row in data.protocol.table]
    assert about[0]["frequency_Hz"] == data.frequency


@pytest.mark.slow
def test_estimates_come_back_to_the_last_bit(tmp_path) -> None:
    estimate = Estimate(
        probabilities=(0.01, 0.98, 0.01),
        bend_angle_deg=-12.3456789,
        bend_deviation_deg=0.25,
        touch_map=np.random.default_rng(2).random((32, 80), dtype=np.float32),
        touches=(
            TouchEstimate(0.05, 0.02, 9.5, 1e-3, 0.9),
            TouchEstimate(0.1, 0.04, np.nan, 2e-3, 0.7),
        ),
        problems=("channel 0-1 is left out",),
    )
    path = tmp_path / "run.mcap"
    found = written(path, Reading(a_frame(), estimate, 0.004, 3.3, unusable=2))
    topics = ("/eitskin/bend", "/eitskin/touch_map", "/eitskin/touches", "/tf", "/diagnostics")
    bend, picture, touches, transforms, diagnostics = (found[topic][0][1] for topic in topics)
    assert bend.name == ["bend"]
    assert bend.position.tolist() == [np.radians(-12.3456789)]
    assert (picture.height, picture.width, picture.step) == (32, 80, 320)
    assert (picture.encoding, picture.is_bigendian) == ("32FC1", 0)
    assert picture.data.tobytes() == estimate.touch_map.tobytes()
    assert tuple(field.name for field in touches.fields) == TOUCH_FIELDS
    assert [field.offset for field in touches.fields] == [0, 4, 8, 12, 16, 20]
    rows = rows_of(touches)
    expected = [[0.05, 0.02, 0, 0.9, 9.5, 1e-3], [0.1, 0.04, 0, 0.7, np.nan, 2e-3]]
    assert np.array_equal(rows, np.array(expected, np.float32), equal_nan=True)
    assert not touches.is_dense
    at = [
        (each.header.frame_id, each.child_frame_id, each.transform.translation.x)
        for each in transforms.transforms
    ]
    assert at == [(NAME, f"{NAME}/touch_{i}", rows[i, 0]) for i in range(2)]
    assert transforms.transforms[0].transform.rotation.w == 1.0
    level, text, values = values_of(diagnostics, "eitskin: sensor")
    assert (level, text) == (1, "touch; channel 0-1 is left out")
    assert values["bend angle [deg]"] == "-12.3456789"
    assert float(values["bend deviation [deg]"]) == 0.25
    assert (values["latency [s]"], values["rate [Hz]"]) == ("0.004", "3.3")
    assert (values["unusable frames"], values["probability 1"]) == ("2", "0.98")


NO_TOUCHES = {"state": State.IDLE, "touches": ()}
UNKNOWN_STATE = NOT_ESTIMATED | {"probabilities": np.full(3, UNKNOWN)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "problem", "status", "topics"),
    [
        (UNKNOWN_STATE, "", (0, "state not estimated"), set()),
        (NO_TOUCHES, "", (0, "idle"), {"bend", "touch_map", "touches"}),
        (None, "too few channels", (2, "too few channels"), set()),
    ],
)
def test_what_is_not_estimated_has_no_topic(changes, problem, status, topics, tmp_path) -> None:
    estimate = None if changes is None else Estimate(**changes)
    reading = Reading(a_frame(), estimate, 0.0, UNKNOWN, unusable=1, problem=problem)
    found = written(tmp_path / "run.mcap", reading)
    assert set(found) - {"/diagnostics"} == {
        f"/eitskin/{topic}" for topic in {"sensor", "impedance", *topics}
    }
    *said, values = values_of(found["/diagnostics"][0][1], "eitskin: sensor")
    assert tuple(said) == status
    known = {"state", "bend angle [deg]", "probability 0"} & values.keys()
    assert bool(known) == (changes is NO_TOUCHES)
    if topics:
        touches = found["/eitskin/touches"][0][1]
        assert (touches.width, len(touches.data)) == (0, 0)


def test_topics_are_those_of_the_page_and_stamps_follow_sessions_and_clock():
    page = (Path(__file__).parents[2] / "docs" / "reference" / "live.md").read_text()
    for topic, kind in RosMessages().types.items():
        assert f"| `{topic}` | `{kind.replace('/msg', '')}` |" in page
    for name in TOUCH_FIELDS:
        assert f"`{name}`" in page
    stamps = Stamps()
    times = [(0, 5.0), (0, 5.25), (1, 0.0), (1, 0.5), (1, 0.5), (1, 0.2), (1, 0.3)]
    found = [stamps.stamp_frame(a_frame(time, session)) for session, time in times]
    assert [stamp for stamp, _ in found] == [
        GAP,
        GAP + 250_000_000,
        2 * GAP + 250_000_000,
        2 * GAP + 750_000_000,
        3 * GAP + 750_000_000,  # the time did not go on
        4 * GAP + 750_000_000,  # it went back
        4 * GAP + 850_000_000,
    ]
    assert [begins for _, begins in found] == [True, False, True, False, True, True, False]
    clock = iter([1_700_000_000 * 10**9, 1_600_000_000 * 10**9])
    live = Stamps(lambda: next(clock))
    frames = [a_frame(100.0), a_frame(100.3), a_frame(0.0, session=1)]
    first, second, third = (live.stamp_frame(frame)[0] for frame in frames)
    assert first == 1_700_000_000 * 10**9
    assert second == first + 300_000_000
    assert third == second + 1  # the clock was set back


# Whole or unfinished


def test_a_file_has_its_name_when_it_is_whole_and_nothing_is_replaced(tmp_path) -> None:
    path = tmp_path / "new.mcap"
    killed = McapWriter(path)
    killed.write(Reading(a_frame(), None, UNKNOWN, UNKNOWN))
    assert [each.name for each in tmp_path.iterdir()] == ["new.mcap.unfinished"]
    with pytest.raises(ConfigurationError, match="unfinished exists"):
        McapWriter(path)
    killed.discard()
    assert not list(tmp_path.iterdir())
    (tmp_path / "run.mcap").write_text("a recording")
    with pytest.raises(ConfigurationError, match=r"run\.mcap exists"):
        McapWriter(tmp_path / "run.mcap")
    with pytest.raises(ConfigurationError, match=r"\.mcap"):
        McapWriter(tmp_path / "run.bag")
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigurationError, match="cannot write"):
        McapWriter(tmp_path / "file" / "run.mcap")


# The command


@pytest.mark.slow
def test_the_command_writes_what_the_pipeline_says(pipeline, tmp_path) -> None:
    """Of a session that begins flat and is touched, of frames that the pipeline knows."""
    flat, pressed = pipeline.examples.flat[2], 1 + pipeline.examples.static[2]
    layout = pipeline.layout
    frames = [
        Frame(each, layout.protocol, 0.3 * number, number, frequency=layout.frequency)
        for number, each in enumerate((flat, flat, flat * pressed))
    ]
    with ShardWriter(tmp_path / "recording") as writer:
        for each in frames:
            writer.append(each)
    out = tmp_path / "run.mcap"
    words = (tmp_path / "recording", "--out", out, "--model", "reference.eitmodel")
    said = printed_json("export", "mcap", *words)
    assert (said["frames"], said["estimates"], said["messages"]) == (3, 3, 17)
    found = read(out)
    pipeline.reset()
    data = open_dataset(tmp_path / "recording")  # which rounds them
    estimates = [pipeline.process(data.frame(i)) for i in range(3)]
    for i, estimate in enumerate(estimates):
        assert found["/eitskin/touch_map"][i][1].data.tobytes() == estimate.touch_map.tobytes()
        assert found["/eitskin/bend"][i][1].position[0] == np.radians(estimate.bend_angle_deg)
        rows = rows_of(found["/eitskin/touches"][i][1])
        known = [(*touch[:2], touch.force) for touch in estimate.touches]
        assert np.array_equal(rows[:, [0, 1, 4]], np.reshape(known, (-1, 3)).astype(np.float32))
    assert estimate.state is State.TOUCH
    assert len(rows) >= 1
