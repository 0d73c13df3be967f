"""Frames as dictionaries of tensors."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.schema import FRAME_FIELDS
from eitskin.errors import ConfigurationError
from eitskin.extras import require

if TYPE_CHECKING:
    import torch

Item = dict[str, "torch.Tensor"]

NAMES = (*(field.name for field in FRAME_FIELDS), "reference")


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
