"""Readings as an MCAP file, which Foxglove and rosbag2 open."""

import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from eitskin.closeable import Closeable
from eitskin.errors import ConfigurationError, PartialError
from eitskin.files import atomic_file
from eitskin.frame import Frame
from eitskin.hardware.export.ros_messages import TOPICS, RosMessages
from eitskin.hardware.live import Reading

SUFFIX = ".mcap"
UNFINISHED = ".unfinished"  # ending of the folder that is written to meanwhile
GAP = 10**9  # ns, between a frame and the session that follows it in a recording


class Stamps:
    """When frames were taken, in nanoseconds that only rise.

    Frames know the time since their session began. Live, a session begins when its first frame
    comes, by the clock of this machine. A recording does not say when: the first session is put at
    1 s, and each that follows 1 s after the last frame of the one before. A frame whose time does
    not go on counts as the first of a session.
    """

    def __init__(self, now: Callable[[], int] | None = None) -> None:
        """Begin; `now` is the clock of live sessions [ns]."""
        self._now = now
        self._session = -1
        self._began, self._first, self._last = 0, 0.0, 0

    def of(self, frame: Frame) -> tuple[int, bool]:
        """The frame's stamp [ns], and whether a session begins with it."""
        stamp = self._began + round(1e9 * (frame.time - self._first))
        begins = frame.session != self._session or stamp <= self._last
        if begins:
            stamp = self._last + GAP if self._now is None else max(self._now(), self._last + 1)
            self._session, self._began, self._first = frame.session, stamp, frame.time
        self._last = stamp
        return stamp, begins


class McapWriter(Closeable):
    """Writes readings to one MCAP file, the topics of `ros_messages.TOPICS`.

    The file is written in the folder NAME.mcap.unfinished and takes its name when the writer is
    closed, which it is whenever its `with` block ends, by Ctrl-C too. Where the program was killed
    that folder stays: what it holds lacks its index and at most the last megabyte.

    Attributes:
        path: of the file.
        messages: written so far.
    """

    def __init__(self, path: str | Path, now: Callable[[], int] | None = None) -> None:
        """Make the file.

        Args:
            path: of the file, ending in .mcap; not there yet.
            now: clock of live sessions [ns], such as time.time_ns; see `Stamps`.

        Raises:
            ImportError: naming the extra, where rosbags is missing.
            ConfigurationError: where the file is there already or cannot be made.
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

        Raises PartialError where it cannot be written; nothing more can be then, and there will be
        no file under the name.
        """
        stamp, begins = self._stamps.of(reading.frame)
        said = self._messages.of(reading, stamp)
        if begins:
            said = {"/eitskin/sensor": self._messages.sensor(reading.frame)} | said
        try:
            for topic, message in said.items():
                data = self._messages.serialised(topic, message)
                self._bag.write(self._topic(topic), stamp, data)
        except OSError as error:
            # A chunk that was cut short must stay the last: no index is put behind it.
            bag, self._bag = self._bag, None
            with suppress(OSError):
                bag.abort()
            raise self._stopped(error) from error
        self.messages += len(said)

    def close(self) -> None:
        """Finish the file and give it its name; there is none where nothing was written.

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
            raise self._stopped(error) from error
        shutil.rmtree(self._folder, ignore_errors=True)

    def discard(self) -> None:
        """Close without leaving a file, nor what is left of one that could not be written."""
        bag, self._bag = self._bag, None
        if bag is not None:
            bag.abort()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _topic(self, topic: str) -> Any:
        """Its place in the file; a recording without estimates has no topics of estimates."""
        if topic not in self._topics:
            self._topics[topic] = self._bag.add_connection(
                topic, TOPICS[topic], typestore=self._messages.store
            )
        return self._topics[topic]

    def _stopped(self, error: OSError) -> PartialError:
        return PartialError(
            f"could not write {self.path}: {error.strerror or error}; what was written before lies "
            f"in {self._folder}; make room"
        )


def require_new(path: Path) -> Path:
    """The folder that is written to meanwhile; raises ConfigurationError for a name that is taken.

    Neither a file nor what is left of one is ever replaced: a recording cannot be made again.
    """
    if path.suffix != SUFFIX:
        raise ConfigurationError(f"an MCAP file must end in {SUFFIX}, got {path}")
    folder = path.with_name(path.name + UNFINISHED)
    for taken in (path, folder):
        if taken.exists():
            raise ConfigurationError(
                f"{taken} exists and is not replaced; name another file, or remove it"
            )
    return folder
