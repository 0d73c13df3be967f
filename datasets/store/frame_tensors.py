"""Frames as tensors, and maps of their touches: what networks are trained on."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.bounds import require_axes, require_count, require_length
from eitskin.datasets.store.schema import FRAME_FIELDS
from eitskin.errors import ConfigurationError, DataError
from eitskin.extras import require

if TYPE_CHECKING:
    import torch


MAX_PIXELS = 4096  # of a row or column
Item = dict[str, "torch.Tensor"]

NAMES = (*(field.name for field in FRAME_FIELDS), "reference")


def touch_maps(
    x: ArrayLike,
    y: ArrayLike,
    radius: ArrayLike,
    outline: tuple[float, float] = (0.150, 0.060),
    shape: tuple[int, int] = (32, 80),
) -> NDArray[np.float32]:
    """Touch maps with a disc for every touch.

    Args:
        x, y, radius: positions and radii of touches, (n, touches) [m]; NaN where absent.
        outline: length and width of the sensor [m].
        shape: rows (along y) and columns (along x) of a map.

    Returns:
        (n, *shape) float32: 1 inside a disc, 0 outside, in between on pixels at a disc's edge.
        Rows and columns grow with y and x.

    Raises DataError where a touch has a position and no radius, or one coordinate, and
    ConfigurationError for an outline or a shape that no map can have.

    Example:
        >>> import numpy as np
        >>> from eitskin.datasets import touch_maps
        >>> touch_maps([[0.05]], [[0.02]], [[0.0075]], (0.150, 0.060)).shape[0]
        1
    """
    for name, length in zip(("length", "width"), outline, strict=True):
        require_length(f"{name} of the outline", length)
    for name, count in zip(("rows", "columns"), shape, strict=True):
        require_count(f"{name} of a touch map", count, 1, MAX_PIXELS)
    x, y, radius = (np.asarray(values, dtype=np.float32) for values in (x, y, radius))
    for name, values in (("x", x), ("y", y), ("radius", radius)):
        require_axes(name, values, *(x.shape if x.ndim == 2 else (None, None)), more=False)
    if np.any(np.isfinite(x) != np.isfinite(y)):
        raise DataError("a touch needs both coordinates, got one; pass NaN in both where absent")
    if np.any(np.isfinite(x) & ~np.isfinite(radius)):
        raise DataError(
            "a touch map needs the radius of every touch, got NaN; pass the radius of the indenter "
            "that was used"
        )
    rows, columns = shape
    step_x, step_y = outline[0] / columns, outline[1] / rows
    across = (np.arange(columns, dtype=np.float32) + np.float32(0.5)) * np.float32(step_x)
    up = (np.arange(rows, dtype=np.float32) + np.float32(0.5)) * np.float32(step_y)
    pixel = np.float32(np.sqrt(step_x * step_y))
    maps = np.zeros((len(x), rows, columns), dtype=np.float32)
    for touch in range(x.shape[1]):
        frames = np.flatnonzero(np.isfinite(x[:, touch]))
        cx, cy, r = (values[frames, touch, None, None] for values in (x, y, radius))
        # Several times as fast as `hypot`; metres neither overflow nor underflow.
        distance = np.sqrt((across[None, None, :] - cx) ** 2 + (up[None, :, None] - cy) ** 2)
        # The edge is one pixel wide, so that moving a touch changes its map smoothly.
        disc = np.clip((r - distance) / pixel + np.float32(0.5), 0.0, 1.0)
        maps[frames] = np.maximum(maps[frames], disc)
    return maps


class FrameTensors:
    """Frames in memory, for `torch.utils.data.DataLoader`; items are those of `TorchDataset`."""

    def __init__(self, data: Any, names: Sequence[str] = NAMES) -> None:
        """Read the columns called `names` of a `Dataset`; errors as for `TorchDataset`."""
        require("torch", "training")
        self.data, self.names = data, checked_names(names)
        data.read(*self.names)

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.data)

    def __getitem__(self, index: int) -> Item:
        """Item of frame `index`, negative from the end; raises IndexError beyond either end."""
        if not -len(self) <= index < len(self):
            raise IndexError(f"frame {index} of a dataset of {len(self)}")
        return make_item(self.data, index, self.names)


def checked_names(names: Sequence[str]) -> tuple[str, ...]:
    """Keys of an item; raises ConfigurationError for unknown ones."""
    wrong = sorted(set(names) - set(NAMES))
    if wrong or not names:
        raise ConfigurationError(
            f"expected names of {', '.join(NAMES)}, got {', '.join(wrong) or 'none'}"
        )
    return tuple(names)


def make_item(data: Any, index: int | NDArray[np.int64], names: Sequence[str]) -> Item:
    """Item of one frame of a `Dataset`, or batch of several."""
    values = {name: getattr(data, name)[index] for name in names if name != "reference"}
    row = data.specimen[index]
    if "reference" in names:
        values["reference"] = data.reference[row]
    if "specimen" in names:  # not the row, which is one of the shard
        values["specimen"] = data.specimen_number[row]
    return {name: _tensor(value) for name, value in values.items()}


def _tensor(value: Any) -> "torch.Tensor":
    import torch

    array = np.asarray(value)
    return torch.from_numpy(array.astype(np.int64) if array.dtype.kind == "u" else array.copy())
