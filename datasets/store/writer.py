"""Writer of datasets that grow frame by frame, such as recordings."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.closeable import Closeable
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.folder import new_folder
from eitskin.datasets.store.manifest import Manifest, ShardEntry, write_manifest
from eitskin.datasets.store.schema import MAX_TOUCHES, UNKNOWN_STATE
from eitskin.datasets.store.shard import write_entry
from eitskin.errors import ConfigurationError
from eitskin.frame import Frame, Status
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.scene.scene import Touch


class ShardWriter(Closeable):
    """Writer of frames into a new folder, shard by shard, with a manifest after each shard.

    A crash loses the frames of the last, unfinished shard: the manifest lists the shards before.
    Values that are not finite are written as 0, with the status NOT_FINITE.

    Use as a context manager:

        with ShardWriter("run", reference) as writer:
            writer.append(frame)

    Attributes:
        folder: folder of the dataset.
        readable: number of frames in finished shards, which survive a crash.

    Example:
        >>> import numpy as np
        >>> from eitskin import Frame, Protocol
        >>> from eitskin.datasets import ShardWriter, open_dataset
        >>> writer = ShardWriter("monday")
        >>> writer.append(Frame(np.full(28, 600.0), Protocol.pairwise(8)))
        >>> writer.close()
        >>> len(open_dataset("monday"))
        1
    """

    def __init__(
        self,
        folder: str | Path,
        reference: NDArray[Any] | None = None,
        *,
        design: SensorDesign | None = None,
        source: str = "measured",
        frames_per_shard: int = 256,
    ) -> None:
        """Start a dataset in `folder`, which must be new or empty.

        Args:
            folder: folder of the dataset.
            reference: flat, untouched sensor, (C,) [ohm]; the first frame of the first shard with
                only finite values when omitted.
            design: design of the sensor, where known.
            source: "measured" or "simulated".
            frames_per_shard: number of frames in a file, at most lost in a crash.
        """
        self.folder = new_folder(Path(folder))
        self._reference = reference
        self._shared: dict[str, Any] = {"design": design, "source": source}
        self._frames_per_shard = frames_per_shard
        self.readable = 0
        self._rows: list[tuple[Frame, Mapping[str, Any]]] = []
        self._entries: list[ShardEntry] = []

    def append(
        self,
        frame: Frame,
        *,
        state: int = UNKNOWN_STATE,
        bend_angle_deg: float = np.nan,
        touches: Sequence[Touch] = (),
        touch_reference: NDArray[Any] | None = None,
    ) -> None:
        """Add one frame with its known labels; raises FrameError for another protocol."""
        protocol = self._shared.setdefault("protocol", frame.protocol)
        protocol.require_same(
            frame.protocol,
            "this dataset holds frames of",
            "the next frame has",
            "record each protocol into its own folder",
        )
        self._shared.setdefault("frequency", frame.frequency)
        labels: dict[str, Any] = {"state": state, "bend_angle_deg": bend_angle_deg}
        labels["touch_reference"] = (
            np.full(len(protocol), np.nan) if touch_reference is None else touch_reference
        )
        labels |= touch_columns(touches)
        self._rows.append((frame, labels))
        if len(self._rows) == self._frames_per_shard:
            self._finish_shard()

    def close(self) -> None:
        """Write the remaining frames; a writer without frames leaves no dataset."""
        if self._rows:
            self._finish_shard()
        elif self.readable < self._count:
            self._list_shards()  # which failed before

    def _finish_shard(self) -> None:
        frames = [frame for frame, _ in self._rows]
        labels = {name: np.array([row[name] for _, row in self._rows]) for name in self._rows[0][1]}
        with np.errstate(over="ignore"):  # what single precision cannot hold is not finite
            impedance = np.array([frame.impedance for frame in frames]).astype(np.complex64)
        status = np.array([frame.status for frame in frames])
        finite = np.isfinite(impedance)
        impedance[~finite] = 0.0
        status[~finite] |= np.uint8(Status.NOT_FINITE)
        if self._reference is None:
            self._reference = impedance[int(finite.all(axis=1).argmax())]
        data = Dataset.from_arrays(
            impedance,
            self._reference,
            time=np.array([frame.time for frame in frames]),
            status=status,
            episode=np.array([frame.session for frame in frames]),
            number=np.array([frame.number for frame in frames]),
            **labels,
            **self._shared,
        )
        entry = write_entry(self.folder, len(self._entries), data, self._count)
        self._rows.clear()
        self._entries.append(entry)
        self._list_shards()

    @property
    def _count(self) -> int:
        """Number of frames in finished shards, listed or not."""
        return sum(entry.count for entry in self._entries)

    def _list_shards(self) -> None:
        manifest = Manifest.from_shards(self._shared["source"], self._entries)
        write_manifest(self.folder, manifest)
        self.readable = self._count


def touch_columns(touches: Sequence[Touch]) -> dict[str, NDArray[np.float32]]:
    """Touch arrays of one frame, (4,) each; raises ConfigurationError for too many touches."""
    if len(touches) > MAX_TOUCHES:
        raise ConfigurationError(
            f"a dataset holds at most {MAX_TOUCHES} touches per frame, got {len(touches)}"
        )
    columns = np.full((4, MAX_TOUCHES), np.nan, dtype=np.float32)
    for number, touch in enumerate(touches):
        columns[:, number] = touch.x, touch.y, touch.force, touch.indenter.rims[1]
    return dict(zip(("touch_x", "touch_y", "touch_force", "touch_radius"), columns, strict=True))
