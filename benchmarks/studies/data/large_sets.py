"""Time and memory of large datasets, from making to shuffling.

Run by `python -m eitskin.benchmarks.studies.data.large_sets --out FOLDER`, on Linux. FOLDER takes
some gigabytes, and is left empty.

Two datasets: one of simulated frames, episodes of 50 sensors whose bends and touches are held for
tens of seconds, so that many frames share a solved scene and each has noise of its own; and one of
many small shards of made-up frames, which is compacted. Each step runs in a process of its own.
Prints, as Markdown, the time of each step, the time of all processors, and the largest memory of a
process.
"""

import argparse
import dataclasses
import hashlib
import multiprocessing
import resource
import shutil
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from eitskin.datasets.generation.generate import RECIPE, generate
from eitskin.datasets.generation.verification import verify
from eitskin.datasets.recipe.episode import RandomEpisodes
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.datasets.recipe.specimen import Specimens
from eitskin.datasets.store.compaction import compact
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.folder import open_dataset
from eitskin.datasets.store.manifest import Manifest, ShardEntry, write_manifest
from eitskin.datasets.store.shard import shard_bytes, shard_name
from eitskin.datasets.store.torch_dataset import ShuffledShards
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol
from eitskin.provenance import Provenance
from eitskin.simulator.instrument.instrument import Instrument

WORKERS = 2
FRAMES, SHARDS = 1_000_000, 10_000
FRAMES_PER_EPISODE, FRAMES_PER_SHARD, MADE_UP_FRAMES = 2000, 4000, 1000
BATCH = 256
HEAD = "| step | time [s] | of processors [s] | memory [MB] |\n|---|---|---|---|"


@dataclass(frozen=True, slots=True)
class Cost:
    """Cost of one step.

    Attributes:
        seconds: time.
        processor: time of all processors, with child processes [s].
        memory_mb: largest memory of a process [MB].
        found: result of the step.
    """

    seconds: float
    processor: float
    memory_mb: float
    found: Any


def simulated(frames: int) -> Recipe:
    """Recipe of 50 sensors, whose bends and touches are held for tens of seconds."""
    return Recipe(
        name="large",
        seed=1,
        resolution="coarse",
        frames_per_shard=FRAMES_PER_SHARD,
        instrument=Instrument.ad5940(),
        specimens=Specimens(count=50, conductivity=0.15, contact_impedance=0.15),
        episodes=(
            RandomEpisodes(
                count=max(1, frames // FRAMES_PER_EPISODE),
                frames=min(frames, FRAMES_PER_EPISODE),
                angle_deg=(-20.0, 50.0),
                speed_deg_s=(60.0, 200.0),
                rest_s=(20.0, 60.0),
                pause_s=(10.0, 40.0),
                hold_s=(10.0, 40.0),
                touches=(1, 4),
                force=(4.0, 12.0),
                relaxation=False,
            ),
        ),
    )


def made_up(shards: int) -> Recipe:
    """Recipe that the made-up frames claim to be of: four electrodes, 1,000 frames a shard."""
    sensor = SensorDesign.reference()
    return Recipe(
        name="made_up",
        sensor=dataclasses.replace(sensor, electrodes=sensor.electrodes[::2]),
        frames_per_shard=MADE_UP_FRAMES,
        specimens=Specimens(count=min(1000, shards)),
        scenes=(SceneGroup("idle", count=MADE_UP_FRAMES * shards),),
    )


def write_made_up(recipe: Recipe, folder: Path) -> None:
    """Write shards of noise, as `generate` would have named and listed them.

    The shards differ in their specimen and the numbers of their frames; the noise is the same.
    """
    folder.mkdir(parents=True)
    text, entries = recipe.to_toml(), []
    (folder / RECIPE).write_text(text)
    pattern = shard_bytes(_noise(recipe, text))
    shards = recipe.frames // MADE_UP_FRAMES
    for shard in range(shards):
        first, specimen = shard * MADE_UP_FRAMES, shard * recipe.specimens.count // shards
        with _writable(pattern) as file:
            file.attrs["first_index"] = first
            file["specimen_number"][0] = specimen
            file["reference"][0] += specimen
            file["number"][:] += first
            file.flush()
            content = file.id.get_file_image()
        (folder / shard_name(shard)).write_bytes(content)
        checksum = hashlib.sha256(content).hexdigest()
        entries.append(ShardEntry(shard_name(shard), first, MADE_UP_FRAMES, checksum))
    digest = hashlib.sha256(text.encode()).hexdigest()
    write_manifest(
        folder, Manifest("simulated", digest, recipe.seed, recipe.frames, tuple(entries))
    )


def _writable(content: bytes) -> h5py.File:
    """HDF5 file in memory with this content at first."""
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    access.set_fapl_core(backing_store=False)
    access.set_file_image(content)
    return h5py.File(h5py.h5f.open(b"made_up", flags=h5py.h5f.ACC_RDWR, fapl=access))


def _noise(recipe: Recipe, text: str) -> Dataset:
    """Frames of one shard."""
    rng, protocol = np.random.default_rng(0), Protocol.pairwise(len(recipe.sensor.electrodes))
    size = (MADE_UP_FRAMES, len(protocol))
    return Dataset.from_arrays(
        500.0 + rng.normal(size=size) + 1j * rng.normal(size=size),
        np.full(len(protocol), 500.0),
        touch_reference=500.0 + rng.normal(size=size),
        state=rng.integers(0, 3, MADE_UP_FRAMES),
        bend_angle_deg=rng.uniform(-20.0, 50.0, MADE_UP_FRAMES),
        protocol=protocol,
        source="simulated",
        recipe=text,
        seed=recipe.seed,
        design=recipe.sensor,
    )


# Steps, each in a process of its own


def step_generate(recipe: Recipe, folder: Path) -> tuple[float, float]:
    """Make a dataset; returns the largest memory of a worker, after a tenth and at the end [MB]."""
    seen: dict[bool, float] = {}

    def watch(done: int, total: int) -> None:
        workers = multiprocessing.active_children()
        seen[done > total / 10] = max(map(_peak_mb, workers), default=0.0)

    generate(recipe, folder, workers=WORKERS, progress=watch)
    return seen[False], seen[True]


def _peak_mb(process: Any) -> float:
    """Largest memory so far of a process [MB]; 0 for one that has ended."""
    try:
        text = Path(f"/proc/{process.pid}/status").read_text()
    except OSError:
        return 0.0
    lines = [line.split() for line in text.splitlines() if line.startswith("VmHWM")]
    return int(lines[0][1]) / 1e3 if lines else 0.0


def step_resume(recipe: Recipe, folder: Path) -> None:
    """Examine all shards of a dataset without a manifest, and write the manifest."""
    (folder / "manifest.json").unlink()
    generate(recipe, folder, workers=WORKERS, resume=True)


def step_open(folder: Path) -> int:
    """Open a dataset."""
    return len(open_dataset(folder))


def step_column(folder: Path, name: str) -> int:
    """Open a dataset and use one column."""
    return len(getattr(open_dataset(folder), name))


def step_verify(folder: Path) -> None:
    """Verify a dataset."""
    if verify(folder, workers=WORKERS).damage:
        raise RuntimeError(f"{folder} is damaged")


def step_compact(folder: Path, out: Path) -> None:
    """Compact a dataset."""
    compact(folder, out, workers=WORKERS)


def step_shuffle(folder: Path) -> int:
    """All frames in a random order, in batches of tensors."""
    return sum(len(item["state"]) for item in ShuffledShards(folder, batch=BATCH))


def cost(task: Callable[..., Any], *arguments: Any) -> Cost:
    """Cost of a step in a new process."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_measured, task, arguments).result()


def _measured(task: Callable[..., Any], arguments: tuple[Any, ...]) -> Cost:
    start, before = time.perf_counter(), _processor()
    found = task(*arguments)
    seconds, processor = time.perf_counter() - start, _processor() - before
    most = max(resource.getrusage(who).ru_maxrss for who in _WHO)
    return Cost(seconds, processor, most / 1e3, found)


_WHO = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)


def _processor() -> float:
    used = [resource.getrusage(who) for who in _WHO]
    return sum(each.ru_utime + each.ru_stime for each in used)


def steps_of(recipe: Recipe, folder: Path, compacted: Path) -> Iterator[tuple[str, Cost]]:
    """Steps that every dataset goes through, with their names."""
    yield "`--resume`, all finished", cost(step_resume, recipe, folder)
    yield "`open_dataset`", cost(step_open, folder)
    yield "the same, and one column, `state`", cost(step_column, folder, "state")
    yield "the same, and one column, `impedance`", cost(step_column, folder, "impedance")
    yield "`verify`", cost(step_verify, folder)
    yield "`compact`", cost(step_compact, folder, compacted)
    yield "`compact`, then `verify`", cost(step_verify, compacted)
    yield "`compact`, then `state`", cost(step_column, compacted, "state")
    yield "`compact`, then shuffled", cost(step_shuffle, compacted)


def _gigabytes(folder: Path) -> float:
    return sum(path.stat().st_size for path in folder.glob("shard-*.h5")) / 1e9


def measure_simulated(recipe: Recipe, folder: Path) -> None:
    """Print the table of the simulated dataset, and the memory of a worker on the way."""
    made = measure("simulated", recipe, folder, step_generate)
    print(f"- simulated, frames: {recipe.frames}\n- simulated, shards: {recipe.shards}")
    print(f"- simulated, memory of a worker after a tenth of the frames [MB]: {made[0]:.0f}")
    print(f"- simulated, memory of a worker at the end [MB]: {made[1]:.0f}", flush=True)


def measure(title: str, recipe: Recipe, folder: Path, make: Callable[[Recipe, Path], Any]) -> Any:
    """Print the table of one dataset, and remove the dataset; returns what `make` does."""
    compacted = folder.with_name("compacted")
    try:
        print(f"\n**{title}**\n\n{HEAD}")
        made = cost(make, recipe, folder)
        print(_row("making", made), flush=True)
        for name, found in steps_of(recipe, folder, compacted):
            print(_row(name, found), flush=True)
        print(f"\n- {title}, size [GB]: {_gigabytes(folder):.2f}")
        print(f"- {title}, compacted, size [GB]: {_gigabytes(compacted):.2f}")
    finally:
        for each in (folder, compacted):
            shutil.rmtree(each, ignore_errors=True)
    return made.found


def _row(name: str, found: Cost) -> str:
    cells = [f"{found.seconds:.3g}", f"{found.processor:.3g}", f"{found.memory_mb:.0f}"]
    return f"| {name} | {' | '.join(cells)} |"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder to work in")
    parser.add_argument("--frames", type=int, default=FRAMES, help="simulated; 0 for none")
    parser.add_argument("--shards", type=int, default=SHARDS, help="of made-up frames; 0 for none")
    arguments = parser.parse_args()
    if arguments.frames:
        measure_simulated(simulated(arguments.frames), arguments.out / "simulated")
    if arguments.shards:
        recipe, folder = made_up(arguments.shards), arguments.out / "made_up"
        measure("made up", recipe, folder, write_made_up)
    print(f"\n{Provenance.now(0)}")


if __name__ == "__main__":
    main()
