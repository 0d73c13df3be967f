"""Readings as an MCAP file, for Foxglove and rosbag2."""

import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from eitskin.closeable import Closeable
from eitskin.errors import ConfigurationError, PartialError
from eitskin.files import atomic_file
from eitskin.frame import Frame
from eitskin.hardware.live import Reading
from eitskin.hardware.ros2.messages import RosMessages

SUFFIX = ".mcap"
UNFINISHED_SUFFIX = ".unfinished"  # ending of the folder of an unfinished file
GAP = 10**9  # ns, between a frame and the session that follows it in a recording


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
