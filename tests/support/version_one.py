"""Sets as version 1 of the format held them: every shard with the references of all specimens."""

import hashlib
import json
from pathlib import Path

import h5py
import numpy as np

from eitskin.datasets import Dataset, save_dataset


def save_version_one(data: Dataset, folder: Path, frames_per_shard: int) -> Path:
    """Write `data`, with specimens from 0 on, as a set of version 1; gives the folder."""
    save_dataset(data, folder, frames_per_shard)
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["format_version"] = 1
    for entry in manifest["shards"]:
        path, frames = folder / entry["name"], slice(entry["first_index"], None)
        as_version_one(path, data.select(frames).select(slice(entry["count"])))
        entry["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder


def as_version_one(path: Path, data: Dataset) -> None:
    """Turn the shard of `data` into one of version 1."""
    with h5py.File(path, "r+") as file:
        file.attrs["format_version"] = 1
        del file["specimen_number"], file["number"]
        file["specimen"][...] = data.specimen
        options = {"chunks": data.reference.shape, "compression": "gzip"}
        del file["reference"]
        file.create_dataset("reference", data=np.asarray(data.reference), **options)
