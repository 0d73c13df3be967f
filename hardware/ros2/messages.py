"""Standard ROS 2 messages of a reading: topics, types, units.

And an MCAP file of them, for Foxglove and rosbag2.
"""

import json
import math
import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.closeable import Closeable
from eitskin.errors import ConfigurationError, PartialError
from eitskin.extras import require
from eitskin.files import atomic_file
from eitskin.frame import Frame, Status
from eitskin.hardware.live import Estimate, Reading

NAME = "eitskin"
"""Name of a skin that has no other: of its topics, and of its frame of coordinates in headers (the
flat sensor, x along, y across, z = 0 at the touched side)."""

TOPICS = {
    "sensor": "std_msgs/msg/String",
    "impedance": "std_msgs/msg/Float64MultiArray",
    "bend": "sensor_msgs/msg/JointState",
    "touch_map": "sensor_msgs/msg/Image",
    "touches": "sensor_msgs/msg/PointCloud2",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
"""Types by topic; those without a slash stand under the name of the skin."""

TOUCH_FIELDS = ("x", "y", "z", "strength", "force", "deviation")
_FLOAT32 = 7  # sensor_msgs/PointField
_OK, _WARN, _ERROR = 0, 1, 2  # diagnostic_msgs/DiagnosticStatus

Fields = Mapping[str, Any]
"""Message by the names of its fields; nested messages are mappings, too."""
SUFFIX = ".mcap"
UNFINISHED_SUFFIX = ".unfinished"  # ending of the folder of an unfinished file
GAP = 10**9  # ns, between a frame and the session that follows it in a recording


def build_message(store: Any, kind: str, fields: Fields) -> Any:
    """Message of rosbags of a type in a store, from nested mappings of its fields."""
    from rosbags.interfaces import Nodetype

    values = dict(fields)
    for name, (node, inner) in store.fielddefs[kind][1]:
        if node == Nodetype.NAME:
            values[name] = build_message(store, inner, values[name])
        elif node == Nodetype.SEQUENCE and inner[0][0] == Nodetype.NAME:
            values[name] = [build_message(store, inner[0][1], value) for value in values[name]]
    return store.types[kind](**values)


class RosMessages:
    """Maker of ROS 2 messages of readings, nested mappings of their fields, and of their CDR form.

    Attributes:
        name: name of the skin.
        types: types of the messages by topic.
        store: definitions of the standard messages in rosbags; the same in every ROS 2.
    """

    def __init__(self, name: str = NAME) -> None:
        """Load the definitions; raises ImportError, naming the extra, where rosbags is missing."""
        require("rosbags", "ros")
        from rosbags.typesys import Stores, get_typestore

        self.name = name
        self.types = {self.topic(topic): kind for topic, kind in TOPICS.items()}
        self.store: Any = get_typestore(Stores.ROS2_HUMBLE)

    def topic(self, topic: str) -> str:
        """Full name of one of `TOPICS`."""
        return topic if topic.startswith("/") else f"/{self.name}/{topic}"

    def serialise(self, topic: str, message: Fields) -> bytes:
        """Bytes of `message` for `topic`."""
        kind = self.types[topic]
        return bytes(self.store.serialize_cdr(build_message(self.store, kind, message), kind))

    def sensor(self, frame: Frame) -> dict[str, Fields]:
        """Message of the topic `sensor`: measurement pattern and units of every topic, as JSON."""
        text = {
            "measurements": frame.protocol.labels,
            "protocol": asdict(frame.protocol),
            "frequency_Hz": frame.frequency,
            "units": {
                self.topic("impedance"): "ohm; real, imaginary",
                self.topic("bend"): "rad",
                self.topic("touch_map"): "touched share 0 to 1; rows and columns grow with y and x",
                self.topic("touches"): "x, y, z, deviation: m; force: N; strength: 0 to 1",
            },
        }
        return {self.topic("sensor"): {"data": json.dumps(text)}}

    def make_messages(self, reading: Reading, stamp: int) -> dict[str, Fields]:
        """Messages of one reading at `stamp` [ns], by topic.

        A reading without estimate has no topics of estimates, and a quantity that the pipeline does
        not estimate has none. The stamp is the time of the frame,
        not of the estimate, which is ready a little later.
        """
        frame, estimate = reading.frame, reading.estimate
        seconds, nanoseconds = divmod(stamp, 10**9)
        time = {"sec": seconds, "nanosec": nanoseconds}
        header = {"header": {"stamp": time, "frame_id": self.name}}
        messages = {self.topic("impedance"): _impedance(frame)}
        if estimate is not None:
            messages |= self._estimate_messages(header, estimate)
        statuses = [self._sensor_status(reading), self._channel_status(frame)]
        return messages | {"/diagnostics": {**header, "status": statuses}}

    def _estimate_messages(self, header: Fields, estimate: Estimate) -> dict[str, Fields]:
        """Messages of the quantities that the pipeline estimates, by topic."""
        messages: dict[str, Fields] = {}
        if estimate.bend_angle_deg is not None:
            none = {"velocity": np.zeros(0), "effort": np.zeros(0)}
            angle = np.radians([estimate.bend_angle_deg])
            messages[self.topic("bend")] = {**header, "name": ["bend"], "position": angle, **none}
        if estimate.touch_map is not None:
            messages[self.topic("touch_map")] = {**header, **_image(estimate.touch_map)}
        if estimate.touches is not None:
            rows = touch_rows(estimate)
            messages[self.topic("touches")] = {**header, **_points(rows)}
            transforms = [
                {
                    **header,
                    "child_frame_id": f"{self.name}/touch_{number}",
                    "transform": {
                        "translation": {"x": x, "y": y, "z": z},
                        "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
                    },
                }
                for number, (x, y, z) in enumerate(rows[:, :3].astype(float).tolist())
            ]
            if transforms:  # frames of coordinates at the touches, in their order
                messages["/tf"] = {"transforms": transforms}
        return messages

    def _sensor_status(self, reading: Reading) -> Fields:
        """Status of the sensor: state and doubts; unknown values are left out."""
        frame, estimate = reading.frame, reading.estimate
        values: dict[str, object] = {
            "session": frame.session,
            "number": frame.number,
            "time [s]": frame.time,
            "frequency [Hz]": frame.frequency,
            "unusable frames": reading.unusable,
            "latency [s]": reading.latency,
            "rate [Hz]": reading.rate,
        }
        level, message = (_ERROR, reading.problem) if reading.problem else (_OK, "not estimated")
        if estimate is not None:
            level = _WARN if estimate.problems else _OK
            state = "state not estimated"
            if estimate.state is not None:
                state = getattr(estimate.state, "name", str(estimate.state)).lower()
                values["state"] = state
            message = "; ".join((state, *estimate.problems))
            values["bend angle [deg]"] = estimate.bend_angle_deg
            values["bend deviation [deg]"] = getattr(estimate, "bend_deviation_deg", math.nan)
            values |= {
                f"probability {i}": float(value) for i, value in enumerate(estimate.probabilities)
            }
        finite_fields = {
            name: value
            for name, value in values.items()
            if not (value is None or (isinstance(value, float) and math.isnan(value)))
        }
        return self._status(f"{self.name}: sensor", level, message, finite_fields)

    def _channel_status(self, frame: Frame) -> Fields:
        """Status of each measurement, by its label."""
        health = [Status(int(bits)).name or str(bits) if bits else "good" for bits in frame.status]
        bad = sum(each != "good" for each in health)
        return self._status(
            f"{self.name}: channels",
            _WARN if bad else _OK,
            f"{bad} of {len(health)} channels are bad" if bad else "all channels are good",
            dict(zip(frame.protocol.labels, health, strict=True)),
        )

    def _status(self, name: str, level: int, message: str, values: dict[str, Any]) -> Fields:
        # Floats with all their digits.
        texts = {k: repr(v) if isinstance(v, float) else str(v) for k, v in values.items()}
        return {
            "level": level,
            "name": name,
            "message": message,
            "hardware_id": self.name,
            "values": [{"key": key, "value": text} for key, text in texts.items()],
        }


def _impedance(frame: Frame) -> Fields:
    channels = len(frame.protocol)
    shape = (("measurement", channels, 2 * channels), ("real, imaginary [ohm]", 2, 2))
    dimensions = [{"label": label, "size": size, "stride": step} for label, size, step in shape]
    layout = {"dim": dimensions, "data_offset": 0}
    return {"layout": layout, "data": frame.impedance.view(float)}


def _image(touch_map: NDArray[np.floating]) -> Fields:
    values = np.ascontiguousarray(touch_map, dtype="<f4")
    rows, columns = values.shape
    return {
        "height": rows,
        "width": columns,
        "encoding": "32FC1",
        "is_bigendian": 0,
        "step": 4 * columns,
        "data": values.reshape(-1).view(np.uint8),
    }


def _points(rows: NDArray[np.float32]) -> Fields:
    step = 4 * len(TOUCH_FIELDS)
    return {
        "height": 1,
        "width": len(rows),
        "fields": [
            {"name": name, "offset": 4 * i, "datatype": _FLOAT32, "count": 1}
            for i, name in enumerate(TOUCH_FIELDS)
        ],
        "is_bigendian": False,
        "point_step": step,
        "row_step": step * len(rows),
        "data": rows.reshape(-1).view(np.uint8),
        "is_dense": bool(np.isfinite(rows).all()),
    }


def touch_rows(estimate: Estimate) -> NDArray[np.float32]:
    """Touches as rows of `TOUCH_FIELDS`, (touches, 6); NaN where the pipeline gives no value."""
    touches = estimate.touches or ()
    rows = np.full((len(touches), len(TOUCH_FIELDS)), np.nan, dtype="<f4")
    for row, touch in zip(rows, touches, strict=True):
        x, y, strength = touch
        force, deviation = (getattr(touch, name, np.nan) for name in ("force", "deviation"))
        row[:] = x, y, 0.0, strength, force, deviation
    return rows


class Stamps:
    """Time stamps of frames [ns], strictly increasing.

    A frame has the time since its session began. A live session begins when its first frame comes,
    by the clock of this machine. A recording has no date: its first session begins at 1 s, every
    other one 1 s after the last frame of the session before. A frame whose time does not increase
    begins a session.
    """

    def __init__(self, now: Callable[[], int] | None = None) -> None:
        """Begin without a session; `now` is the clock of live sessions [ns]."""
        self._now = now
        self._session = -1
        self._began, self._first, self._last = 0, 0.0, 0

    def stamp_frame(self, frame: Frame) -> tuple[int, bool]:
        """Stamp of `frame` [ns], and whether the frame begins a session."""
        stamp = self._began + round(1e9 * (frame.time - self._first))
        begins = frame.session != self._session or stamp <= self._last
        if begins:
            stamp = self._last + GAP if self._now is None else max(self._now(), self._last + 1)
            self._session, self._began, self._first = frame.session, stamp, frame.time
        self._last = stamp
        return stamp, begins


class McapWriter(Closeable):
    """Writer of readings to one MCAP file, with the topics of `messages.TOPICS`.

    The file grows in the folder NAME.mcap.unfinished and takes its name when the writer is closed,
    at the latest at the end of its `with` block, also by Ctrl-C. Where the program was killed that
    folder stays; its file lacks the index and at most the last megabyte.

    Attributes:
        path: path of the file.
        messages: number of messages written so far.
    """

    def __init__(self, path: str | Path, now: Callable[[], int] | None = None) -> None:
        """Create the file.

        Args:
            path: path of a new file, ending in .mcap.
            now: clock of live sessions [ns], such as time.time_ns; see `Stamps`.

        Raises:
            ImportError: naming the extra, where rosbags is missing.
            ConfigurationError: where the file exists or cannot be created.
        """
        self.path = Path(path)
        self.messages = 0
        self._messages, self._stamps = RosMessages(), Stamps(now)
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
        from rosbags.rosbag2.errors import WriterError

        self._folder = require_new(self.path)
        bag = Writer(self._folder, version=8, storage_plugin=StoragePlugin.MCAP)
        bag.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        try:
            bag.open()
        except (OSError, WriterError) as error:
            raise ConfigurationError(
                f"cannot write {self.path}: {error}; name a file in a folder that exists and can "
                "be written to"
            ) from error
        self._bag: Any = bag
        self._topics: dict[str, Any] = {}

    def write(self, reading: Reading) -> None:
        """Append one reading.

        Raises PartialError where the reading cannot be written; then no file takes the name.
        """
        stamp, begins = self._stamps.stamp_frame(reading.frame)
        messages = self._messages.make_messages(reading, stamp)
        if begins:
            messages = self._messages.sensor(reading.frame) | messages
        try:
            for topic, message in messages.items():
                data = self._messages.serialise(topic, message)
                self._bag.write(self._topic(topic), stamp, data)
        except OSError as error:
            # A truncated chunk must stay the last: no index may follow.
            bag, self._bag = self._bag, None
            with suppress(OSError):
                bag.abort()
            raise self._partial_error(error) from error
        self.messages += len(messages)

    def close(self) -> None:
        """Finish the file and give it its name; without any message no file is left.

        Raises PartialError where that fails.
        """
        if self._bag is None:
            return
        if not self.messages:
            self.discard()
            return
        bag, self._bag = self._bag, None
        try:
            bag.close()
            with atomic_file(self.path, PartialError) as temporary:
                (self._folder / f"{self._folder.name}{SUFFIX}").replace(temporary)
        except OSError as error:
            with suppress(OSError):
                bag.abort()
            raise self._partial_error(error) from error
        shutil.rmtree(self._folder, ignore_errors=True)

    def discard(self) -> None:
        """Close and remove the unfinished file."""
        bag, self._bag = self._bag, None
        if bag is not None:
            bag.abort()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _topic(self, topic: str) -> Any:
        """Connection of `topic` in the file, made with its first message."""
        if topic not in self._topics:
            self._topics[topic] = self._bag.add_connection(
                topic, self._messages.types[topic], typestore=self._messages.store
            )
        return self._topics[topic]

    def _partial_error(self, error: OSError) -> PartialError:
        return PartialError(
            f"could not write {self.path}: {error.strerror or error}; what was written before lies "
            f"in {self._folder}; make room or give write permission"
        )


def require_new(path: Path) -> Path:
    """Folder of the unfinished file of `path`; raises ConfigurationError for a name that is taken.

    Neither a file nor an unfinished one is ever replaced: a recording cannot be made again.
    """
    if path.suffix != SUFFIX:
        raise ConfigurationError(f"an MCAP file must end in {SUFFIX}, got {path}")
    folder = path.with_name(path.name + UNFINISHED_SUFFIX)
    for existing in (path, folder):
        if existing.exists():
            raise ConfigurationError(
                f"{existing} exists and is not replaced; name another file, or remove it"
            )
    return folder
