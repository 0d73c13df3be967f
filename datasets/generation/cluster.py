"""Dask cluster: shards simulated by workers that may come and go."""

import socket
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from eitskin.datasets.generation.shard_simulation import simulate_shard
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.store.shard import package_versions, shard_name, write_shard
from eitskin.errors import ConfigurationError, PartialError
from eitskin.extras import require
from eitskin.threads import one_thread

CONNECT_SECONDS = 10
WORKERS_SECONDS = 60


def make_shards(
    recipe: Recipe,
    folder: Path,
    shards: Sequence[int],
    address: str,
    report: Callable[[int], None],
) -> list[int]:
    """Simulate `shards` of `recipe` into `folder`, which all workers must see under the same path.

    Calls `report` with the number of each finished shard. The scheduler gives the shard of a lost
    worker to another one. Returns the numbers of shards whose workers died again and again.

    Raises:
        ConfigurationError: where the scheduler at `address` has no workers, or they have other
            packages.
        PartialError: where the scheduler goes away, or workers cannot write.
        ImportError: without dask.distributed.
    """
    distributed = require("distributed", "cluster")
    lost = set(shards)
    with _connected(address) as client:
        # Not pure: results are files, of which the scheduler knows nothing.
        futures = [
            client.submit(
                cluster_task, recipe, folder.resolve(), shard, package_versions(), pure=False
            )
            for shard in shards
        ]
        for future in distributed.as_completed(futures, loop=client.loop):
            if future.status == "finished":
                lost.remove(future.result())
                report(future.result())
            elif future.status == "error":
                error = future.exception()
                if not isinstance(error, distributed.KilledWorker):
                    raise error
            else:
                raise PartialError(
                    f"the dask scheduler at {address} went away, {len(lost)} shards are missing in "
                    f"{folder}; start it again, then continue with --resume"
                )
    return sorted(lost)


def check_scheduler(address: str) -> None:
    """Raise ConfigurationError unless a server answers at `address`, ImportError without dask."""
    require("distributed", "cluster")
    try:
        url = urlsplit(address)
        if url.scheme not in ("tcp", "tls") or not url.hostname or not url.port:
            raise ValueError("expected tcp://HOST:PORT")
        socket.create_connection((url.hostname, url.port), CONNECT_SECONDS).close()
    except (OSError, ValueError) as error:
        raise ConfigurationError(
            f"no dask scheduler answers at '{address}': {error}; start one with 'dask scheduler' "
            "and give the address that it prints, such as tcp://127.0.0.1:8786"
        ) from error


@contextmanager
def _connected(address: str) -> Iterator[Any]:
    """Client of the scheduler at `address`, which has at least one worker."""
    distributed = require("distributed", "cluster")
    with distributed.Client(address, timeout=CONNECT_SECONDS, set_as_default=False) as client:
        try:
            client.wait_for_workers(1, timeout=WORKERS_SECONDS)
        except TimeoutError as error:
            raise ConfigurationError(
                f"the dask scheduler at {address} has no workers; start some with "
                f"'dask worker {address} --nthreads 1'"
            ) from error
        yield client


# From here on: code that runs in a worker.

# Simulators, and the limit on BLAS threads, are shared by all threads of a worker process.
_one_at_a_time = threading.Lock()


def cluster_task(recipe: Recipe, folder: Path, shard: int, versions: Mapping[str, str]) -> int:
    """Simulate and write `shard`; returns its number."""
    found = package_versions()
    if found != versions:
        raise ConfigurationError(
            f"a dask worker has other packages, so its numbers would differ: expected {versions}, "
            f"got {found}; install the same on all machines"
        )
    # More BLAS threads would compete for the cores, and sums would depend on their number.
    with _one_at_a_time, one_thread():
        data = simulate_shard(recipe, shard)
        write_shard(folder / shard_name(shard), data, recipe.shard_range(shard).start)
    return shard
