"""Frames in quantity: what to generate, generating it, keeping it, reading it back."""

from eitskin.datasets.dataset import Dataset
from eitskin.datasets.folder import open_dataset, save_dataset
from eitskin.datasets.generate import generate
from eitskin.datasets.recipe import Recipe
from eitskin.datasets.recordings import RecordingNames, read_recording
from eitskin.datasets.shard import read_shard, write_shard
from eitskin.datasets.state import UNKNOWN_STATE, State
from eitskin.datasets.torch_dataset import ShuffledShards, TorchDataset
from eitskin.datasets.touch_map import touch_maps
from eitskin.datasets.verify import verify
from eitskin.datasets.writer import ShardWriter

__all__ = [
    "UNKNOWN_STATE",
    "Dataset",
    "Recipe",
    "RecordingNames",
    "ShardWriter",
    "ShuffledShards",
    "State",
    "TorchDataset",
    "generate",
    "open_dataset",
    "read_recording",
    "read_shard",
    "save_dataset",
    "touch_maps",
    "verify",
    "write_shard",
]
