"""Datasets read whole: verified, combined, and written again in the newest format."""

import dataclasses
import hashlib
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from eitskin.datasets.store.dataset import Dataset, require_same_origin
from eitskin.datasets.store.folder import Progress, new_folder, read_entry, save_parts
from eitskin.datasets.store.manifest import (
    MANIFEST,
    RECIPE,
    Manifest,
    Names,
    ShardEntry,
    manifest_bytes,
    note_known,
    read_manifest,
)
from eitskin.datasets.store.schema import (
    AVERAGED,
    FORMAT_VERSION,
    LIMITS,
    SpecimenReferences,
)
from eitskin.datasets.store.shard import write_entry
from eitskin.datasets.store.shard_reader import read_shard
from eitskin.datasets.store.worker_processes import run_tasks, worthwhile
from eitskin.errors import ConfigurationError, DataError, PartialError
from eitskin.files import atomic_folder, read_bytes

FRAMES_PER_SHARD = 65536
_REMEDY = "make room or give write permission, then compact again; nothing was left behind"
_MAX_RATIO = 5.0  # of the values of two sensors of one design, beyond which units differ


def combine(
    folders: Sequence[str | Path],
    out: str | Path,
    magnitudes: bool = False,
    progress: Progress | None = None,
) -> Manifest:
    """Write the frames of different datasets into a new folder; returns the manifest.

    Specimens and episodes are numbered again, those of the first dataset first, and keep names;
    a measured specimen without a name has that of its folder from now on. The result counts as
    measured where one of the datasets was, and keeps a recipe only where all datasets share one,
    else what all of their recipes say of averaged frames.
    Takes the memory of one shard.

    Args:
        folders: folders of at least two datasets with the same protocol, design, frequency and
            quantity.
        out: folder of the new dataset, new or empty.
        magnitudes: combine the magnitudes of the values, where some recordings have no sign.
        progress: called with the number of written shards and of all shards.

    Raises:
        DataError: for datasets that cannot be combined, with all differences, or are damaged.
        ConfigurationError: for fewer than two datasets, and where `out` holds something.
        PartialError: where a file cannot be written.

    Example:
        >>> import numpy as np
        >>> from eitskin.datasets import Dataset, combine, save_dataset
        >>> for name, value in {"first": 600.0, "second": 610.0}.items():
        ...     _ = save_dataset(Dataset.from_arrays(np.full((4, 28), value)), name)
        >>> combine(["first", "second"], "both").frames
        8
    """
    paths = [Path(folder) for folder in folders]
    if len(paths) < 2:
        raise ConfigurationError(f"expected at least two datasets to combine, got {len(paths)}")
    manifests = [read_manifest(path) for path in paths]
    _require_distinct(paths, manifests)
    heads = [
        _head(read_entry(path, manifest.shards[0]), magnitudes)
        for path, manifest in zip(paths, manifests, strict=True)
    ]
    for path, head in zip(paths[1:], heads[1:], strict=True):
        if different := "; ".join(_differences(heads[0], head)):
            raise DataError(f"{path} cannot be combined with {paths[0]}: {different}")
    shared = _shared_attributes(heads)
    total = sum(len(manifest.shards) for manifest in manifests)
    parts = _renumber_shards(paths, manifests, magnitudes)
    return save_parts(
        (dataclasses.replace(part, **shared) for part in parts),
        out,
        lambda done: progress(done, total) if progress else None,
    )


def _renumber_shards(
    paths: Sequence[Path], manifests: Sequence[Manifest], magnitudes: bool
) -> Iterator[Dataset]:
    """Shards of all datasets in turn, with specimens and episodes that follow each other."""
    specimens = episodes = 0
    for path, manifest in zip(paths, manifests, strict=True):
        next_specimen, next_episode = specimens, episodes
        for entry in manifest.shards:
            part = _head(read_entry(path, entry), magnitudes)
            numbers = part.specimen_number.astype(np.int64) + specimens
            episode = part.episode.astype(np.int64) + episodes
            next_specimen = max(next_specimen, int(numbers[-1]) + 1)
            next_episode = max(next_episode, int(episode.max()) + 1)
            if next_specimen > LIMITS["specimen"] or next_episode > np.iinfo(np.uint32).max:
                raise DataError(
                    f"the datasets together have more than {LIMITS['specimen']} specimens or 2^32 "
                    "episodes; combine fewer"
                )
            yield dataclasses.replace(
                part,
                specimen_number=numbers.astype(np.uint32),
                episode=episode.astype(np.uint32),
                names=_names(path, manifest, part).shift_numbers(specimens, episodes),
            )
        specimens, episodes = next_specimen, next_episode


def _names(path: Path, manifest: Manifest, part: Dataset) -> Names:
    """Names of a dataset, and of the measured specimens of a part that have none."""
    if part.source != "measured":
        return manifest.names
    by_folder = {n: f"{path.resolve().name} {n}" for n in part.specimen_number.tolist()}
    return manifest.names.merge(Names(by_folder))


def _head(data: Dataset, magnitudes: bool) -> Dataset:
    """Frames as they are combined: magnitudes of the values where these are asked for."""
    if not magnitudes or data.quantity == "voltage":
        return data
    values = ("impedance", "touch_reference", "reference")
    return dataclasses.replace(
        data, quantity="magnitude", **{name: np.abs(getattr(data, name)) for name in values}
    )


def _shared_attributes(heads: Sequence[Dataset]) -> dict[str, Any]:
    """Attributes of the combined dataset that belong to none of its frames."""
    first = heads[0]
    same = all((head.recipe, head.seed) == (first.recipe, first.seed) for head in heads)
    stated = {head.quantity for head in heads}
    return {
        "source": "simulated" if all(h.source == "simulated" for h in heads) else "measured",
        "recipe": first.recipe if same else _averaged_counts(heads),
        "seed": first.seed if same else 0,
        "quantity": first.quantity if len(stated) == 1 else "",
    }


def _averaged_counts(heads: Sequence[Dataset]) -> str:
    """Recipe that says how many frames were averaged, where all datasets had as many."""
    counts = {name: {getattr(head, name) for head in heads} for name in AVERAGED}
    shared = {name: min(values) for name, values in counts.items() if len(values) == 1}
    return "".join(f"{name} = {count}\n" for name, count in shared.items() if count > 1)


def _require_distinct(paths: Sequence[Path], manifests: Sequence[Manifest]) -> None:
    """Raise DataError where two datasets hold the same frames, which would train and test alike."""
    digest: dict[str, Path] = {}
    for path, manifest in zip(paths, manifests, strict=True):
        for entry in manifest.shards:
            if entry.sha256 in digest:
                raise DataError(
                    f"{path} and {digest[entry.sha256]} hold the same frames ({entry.name}); give "
                    "each dataset once"
                )
        digest |= {entry.sha256: path for entry in manifest.shards}


def _differences(one: Dataset, other: Dataset) -> Iterator[str]:
    """Differences that keep two datasets from being combined, each with its remedy."""
    if one.protocol != other.protocol or one.impedance.shape[1] != other.impedance.shape[1]:
        yield (
            f"its frames are of {_describe_channels(other)}, expected {_describe_channels(one)} "
            "(measure with that protocol, or say it with --protocol when importing)"
        )
    elif (ratio := _ratio(one, other)) is not None and not 1 / _MAX_RATIO < ratio < (_MAX_RATIO):
        yield (
            f"its values are {ratio:.3g} times the expected ones (expected 0.2 to 5: import with "
            "the --scale that makes them ohm)"
        )
    if one.design != other.design:
        yield f"its sensor differs ({_design_difference(one, other)})"
    if one.frequency != other.frequency:
        yield (
            f"its frequency is {other.frequency:g} Hz, expected {one.frequency:g} Hz (import with "
            f"--frequency {one.frequency:g} where the gel cannot distinguish the two)"
        )
    if one.reference_frames != other.reference_frames:
        yield (
            f"its references are means of {other.reference_frames} frames, expected "
            f"{one.reference_frames}, so that its noise would be misjudged (generate the simulated "
            "ones with the same reference_frames in their recipes; recordings have 1)"
        )
    if one.quantity and other.quantity and one.quantity != other.quantity:
        remedy = (
            "import voltages as impedances, with --scale 1/current"
            if "voltage" in (one.quantity, other.quantity)
            else "--magnitudes takes the magnitudes of both"
        )
        yield f"its values are of kind {other.quantity}, expected {one.quantity} ({remedy})"


def _describe_channels(data: Dataset) -> str:
    protocol = data.protocol
    return str(protocol) if protocol else f"{data.impedance.shape[1]} channels of no known protocol"


def _ratio(first: Dataset, second: Dataset) -> float | None:
    """Median ratio of the channels' magnitudes; None where too many are zero."""
    sizes = [np.median(np.abs(data.reference), axis=0) for data in (first, second)]
    usable = (sizes[0] > 0) & (sizes[1] > 0)
    return float(np.median(sizes[1][usable] / sizes[0][usable])) if usable.any() else None


def _design_difference(one: Dataset, other: Dataset) -> str:
    if one.design is None or other.design is None:
        return "only one of the two knows its design: import with --sensor"
    fields = dataclasses.fields(one.design)
    names = [f.name for f in fields if getattr(one.design, f.name) != getattr(other.design, f.name)]
    return f"{', '.join(names)}: import with the --sensor of the other, where it is the same"


def compact(
    folder: str | Path,
    out: str | Path,
    frames_per_shard: int | None = FRAMES_PER_SHARD,
    progress: Progress | None = None,
    workers: int = 1,
) -> Manifest:
    """Write the frames of a dataset of any version into a new folder; returns the manifest.

    Frames and labels are the same, in the same order. The bytes depend on the frames alone, not on
    the workers. The dataset in `folder` stays as it is, and each of its shards is verified. The new
    folder appears when it is complete: after an error or Ctrl-C nothing is left.

    Args:
        folder: folder of the dataset.
        out: folder of the new dataset, new or empty.
        frames_per_shard: number of frames in a file; None keeps the shards as they are.
        progress: called with the number of written shards and of all shards.
        workers: number of processes for a large dataset, each of which holds the frames of one new
            shard; more than one needs `if __name__ == "__main__":` in a script.

    Raises:
        DataError: where the dataset is not complete, or a shard is damaged.
        ConfigurationError: where `out` holds something, or for an impossible number of frames.
        PartialError: where a file cannot be written, or a worker dies.

    Example:
        >>> import numpy as np
        >>> from eitskin.datasets import Dataset, compact, save_dataset
        >>> _ = save_dataset(Dataset.from_arrays(np.full((4, 28), 600.0)), "small", 2)
        >>> len(compact("small", "large").shards)
        1
    """
    folder, manifest = Path(folder), read_manifest(Path(folder))
    if frames_per_shard is not None and not 1 <= frames_per_shard <= LIMITS["frame"]:
        raise ConfigurationError(
            f"frames_per_shard must be from 1 to {LIMITS['frame']}, got {frames_per_shard}"
        )
    out = new_folder(Path(out))
    out.rmdir()  # until it is complete
    pieces = list(_pieces(manifest, frames_per_shard))
    entries: list[ShardEntry] = []
    workers = worthwhile(workers, (folder / entry.name for entry in manifest.shards))
    with (
        atomic_folder(out, PartialError, _REMEDY) as temporary,
        closing(run_tasks(partial(_write, folder, temporary), pieces, workers)) as written,
    ):
        for _, entry in written:
            entries.append(entry)
            if progress:
                progress(len(entries), len(pieces))
        shards = tuple(sorted(entries, key=lambda entry: entry.first_index))
        new_manifest = dataclasses.replace(manifest, shards=shards, format_version=FORMAT_VERSION)
        (temporary / MANIFEST).write_bytes(manifest_bytes(new_manifest))
    note_known(new_manifest)
    return new_manifest


_Piece = tuple[int, range, tuple[ShardEntry, ...]]
"""New shard: its number, its frames, and the old shards that hold them."""


def _pieces(manifest: Manifest, frames_per_shard: int | None) -> Iterator[_Piece]:
    shards, frames = manifest.shards, manifest.frames
    pieces = [entry.frames for entry in shards]
    if frames_per_shard is not None:
        starts = range(0, frames, frames_per_shard)
        pieces = [range(start, min(start + frames_per_shard, frames)) for start in starts]
    firsts = [entry.first_index for entry in shards]
    for number, piece in enumerate(pieces):
        first, stop = (bisect_right(firsts, frame) for frame in (piece[0], piece[-1]))
        yield number, piece, shards[first - 1 : stop]


def _write(folder: Path, out: Path, piece: _Piece) -> ShardEntry:
    """Write one new shard; returns its entry."""
    number, frames, sources = piece

    def part(entry: ShardEntry) -> Dataset:
        """Frames of an old shard that are among those of the new one."""
        first, stop = (max(edge - entry.first_index, 0) for edge in (frames.start, frames.stop))
        return read_entry(folder, entry).select(slice(first, stop))

    data = Dataset.collect(map(part, sources), len(frames))
    return write_entry(out, number, data, frames.start, Path.write_bytes)


SHARDS = "shard-*.h5"
_REPAIR = "copy it again, or delete it and generate with --resume"


@dataclass(frozen=True, slots=True)
class DamagedFile:
    """A damaged, missing or foreign file: its name, and the problem with a remedy."""

    file: str
    problem: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of a verification: number of sound shards, of their frames, and all damage."""

    shards: int
    frames: int
    damage: tuple[DamagedFile, ...]


def verify(
    folder: str | Path, watch: Callable[[int, int], None] | None = None, workers: int = 1
) -> Verdict:
    """Check every file of a dataset, including those after a damaged one.

    Checks of a shard: SHA-256, the checksums within the file, format, links, shapes and values, and
    consistency with the other shards. Without a sound manifest, which is damage too, the shards in
    the folder are checked without SHA-256. A worker holds one shard at a time.

    Args:
        folder: folder of the dataset.
        watch: called with the number of checked shards and of all shards.
        workers: number of processes for a large dataset; more than one needs
            `if __name__ == "__main__":` in a script.

    Raises PartialError where a worker dies.

    Example:
        >>> import numpy as np
        >>> from eitskin.datasets import Dataset, save_dataset, verify
        >>> _ = save_dataset(Dataset.from_arrays(np.full((4, 28), 600.0)), "verified")
        >>> verify("verified").damage
        ()
    """
    folder = Path(folder)
    damage: list[DamagedFile] = []
    manifest, entries = None, dict[str, ShardEntry | None]()
    try:
        manifest = read_manifest(folder)
        entries = {entry.name: entry for entry in manifest.shards}
        damage.extend(_damage_outside_shards(folder, manifest))
    except DataError as error:
        damage.append(DamagedFile(MANIFEST, str(error)))
        entries = {path.name: None for path in sorted(folder.glob(SHARDS))}
    sound = frames = 0
    first: Dataset | None = None
    references = SpecimenReferences()
    if watch:
        watch(0, len(entries))
    workers = worthwhile(workers, (folder / name for name in entries))
    task, items = partial(_check, folder, manifest), list(entries.items())
    for number, ((name, _), file_damage) in enumerate(run_tasks(task, items, workers), 1):
        if isinstance(file_damage, str):
            damage.append(DamagedFile(name, file_damage))
        else:
            count, shared = file_damage
            first = shared if first is None else first
            try:
                require_same_origin(first, shared)
                references.add(shared.specimen_number, shared.reference)
                sound, frames = sound + 1, frames + count
            except DataError as error:
                damage.append(DamagedFile(name, str(error)))
        if watch:
            watch(number, len(entries))
    if manifest and not damage:
        note_known(manifest)
    return Verdict(sound, frames, tuple(damage))


def _check(
    folder: Path, manifest: Manifest | None, shard: tuple[str, ShardEntry | None]
) -> tuple[int, Dataset] | str:
    """Frames and shared data of a shard that is sound on its own; the problem of a damaged one."""
    name, entry = shard
    try:
        data = read_entry(folder, entry) if entry else read_shard(folder / name)
    except DataError as error:
        return str(error)
    origin = (data.source, data.seed, hashlib.sha256(data.recipe.encode()).hexdigest())
    if manifest and origin != (manifest.source, manifest.seed, manifest.recipe_sha256):
        return (
            f"{folder / name} was made from another recipe or seed than {MANIFEST} says; {_REPAIR}"
        )
    return len(data), data.select([])


def _damage_outside_shards(folder: Path, manifest: Manifest) -> Iterator[DamagedFile]:
    """Damage of the recipe next to the shards, and shards that the manifest does not name."""
    recipe = folder / RECIPE
    if manifest.source == "simulated" and recipe.is_file():
        digest = hashlib.sha256(read_bytes(recipe, failure=DataError)).hexdigest()
        if digest != manifest.recipe_sha256:
            yield DamagedFile(
                RECIPE,
                f"expected SHA-256 {manifest.recipe_sha256}, got {digest}; copy it again",
            )
    shard_names = {entry.name for entry in manifest.shards}
    for path in sorted(folder.glob(SHARDS)):
        if path.name not in shard_names:
            yield DamagedFile(path.name, f"is not named in {MANIFEST}; move it elsewhere")
