"""Public names of eitskin.datasets, and where each is defined."""

from eitskin.datasets.export.export import export_dataset as export_dataset
from eitskin.datasets.generation.generate import generate as generate
from eitskin.datasets.recipe.recipe import Recipe as Recipe
from eitskin.datasets.recordings.recorded_file import (
    RecordingForm as RecordingForm,
)
from eitskin.datasets.recordings.recorded_file import (
    RecordingNames as RecordingNames,
)
from eitskin.datasets.recordings.recording import (
    Recording as Recording,
)
from eitskin.datasets.recordings.recording import (
    read_recording as read_recording,
)
from eitskin.datasets.store.dataset import Dataset as Dataset
from eitskin.datasets.store.folder import ShardWriter as ShardWriter
from eitskin.datasets.store.folder import StoredDataset as StoredDataset
from eitskin.datasets.store.folder import (
    open_dataset as open_dataset,
)
from eitskin.datasets.store.folder import (
    read_shards as read_shards,
)
from eitskin.datasets.store.folder import (
    save_dataset as save_dataset,
)
from eitskin.datasets.store.frame_tensors import touch_maps as touch_maps
from eitskin.datasets.store.rewriting import combine as combine
from eitskin.datasets.store.rewriting import compact as compact
from eitskin.datasets.store.rewriting import verify as verify
from eitskin.datasets.store.schema import (
    UNKNOWN_STATE as UNKNOWN_STATE,
)
from eitskin.datasets.store.schema import (
    State as State,
)
from eitskin.datasets.store.shard import write_shard as write_shard
from eitskin.datasets.store.shard_reader import read_shard as read_shard
from eitskin.datasets.store.torch_dataset import (
    ShuffledShards as ShuffledShards,
)
from eitskin.datasets.store.torch_dataset import (
    TorchDataset as TorchDataset,
)
