"""Arrays of an HDF5 file that may be damaged or made to do harm, checked before they are read."""

import itertools
import math
from collections.abc import Iterator
from typing import Any

import h5py

from eitskin.errors import DataError

_MOST_EXPANSION = 1100  # deflate makes at most 1,032 bytes of one
_FILTERS = {
    h5py.h5z.FILTER_DEFLATE,
    h5py.h5z.FILTER_SHUFFLE,
    h5py.h5z.FILTER_FLETCHER32,
    h5py.h5z.FILTER_LZF,
}


def all_arrays(group: h5py.h5g.GroupID, inside: str = "") -> Iterator[tuple[str, Any]]:
    """Arrays of a file by path; raises DataError for links, data elsewhere, foreign filters."""
    for raw in group:
        item, name = _plain(group, raw), raw.decode()
        if not isinstance(item, h5py.h5g.GroupID):
            _check_chunks(item, inside + name)
            yield inside + name, item
        elif inside:
            raise DataError(f"'{name}' is nested, virtual or elsewhere; only plain data are read")
        else:
            yield from all_arrays(item, f"{name}/")


def _plain(group: h5py.h5g.GroupID, name: bytes) -> Any:
    """Group or array whose values lie in the file itself, behind known filters."""
    if group.links.get_info(name).type != h5py.h5l.TYPE_HARD:
        raise DataError(
            f"'{name.decode()}' is a soft or external link, and only plain data are read"
        )
    item = h5py.h5o.open(group, name)
    if isinstance(item, h5py.h5g.GroupID):
        return item
    properties = item.get_create_plist() if isinstance(item, h5py.h5d.DatasetID) else None
    if (
        properties is None
        or properties.get_layout() == h5py.h5d.VIRTUAL
        or properties.get_external_count()
    ):
        raise DataError(
            f"'{name.decode()}' is nested, virtual or elsewhere; only plain data are read"
        )
    _check_claims(item, properties, name.decode())
    return item


def _check_claims(array: h5py.h5d.DatasetID, properties: Any, name: str) -> None:
    """Raise DataError for filters and sizes that a file of this format never has.

    HDF5 asks for the memory of a whole chunk, and fills arrays without chunks with one value: a
    file of a few kilobytes could claim gigabytes.
    """
    codes = [properties.get_filter(number)[0] for number in range(properties.get_nfilters())]
    for code in codes:
        if code not in _FILTERS:
            raise DataError(f"'{name}' uses filter {code}; expected gzip or lzf")
    if len(set(codes)) < len(codes):
        raise DataError(f"'{name}' uses a filter twice; expected gzip or lzf once")
    shape = array.shape
    if properties.get_layout() == h5py.h5d.CHUNKED and any(
        step > max(size, 1) for step, size in zip(properties.get_chunk(), shape, strict=True)
    ):
        raise DataError(f"'{name}' has chunks larger than itself; it is damaged")
    require_stored(array, name)


def require_stored(array: h5py.h5d.DatasetID, name: str) -> None:
    """Raise DataError for an array that claims more than any compression leaves of it."""
    claimed = math.prod(array.shape) * array.get_type().get_size()
    if claimed > _MOST_EXPANSION * array.get_storage_size():
        raise DataError(
            f"'{name}' claims {claimed} bytes and stores {array.get_storage_size()}, fewer than "
            "any compression leaves; it is damaged"
        )


def _check_chunks(array: h5py.h5d.DatasetID, path: str) -> None:
    """Raise DataError where a flipped bit of the file's tables would change values unnoticed.

    Tables have no checksum. Where the list of filters is lost, or a chunk is marked as one to which
    some were not applied, compressed bytes would pass for values; where a chunk is listed at
    another place, values would be missing.
    """
    properties = array.get_create_plist()
    if properties.get_layout() != h5py.h5d.CHUNKED:
        return
    found: list[Any] = []
    array.chunk_iter(found.append)
    shape = properties.get_chunk()
    grid = [range(0, size, step) for size, step in zip(array.shape, shape, strict=True)]
    complete = len(found) == math.prod(map(len, grid)) and {
        chunk.chunk_offset for chunk in found
    } == set(itertools.product(*grid))
    size = math.prod(shape) * array.get_type().get_size()
    raw = not properties.get_nfilters()
    sound = all(not chunk.filter_mask and (not raw or chunk.size == size) for chunk in found)
    if found and not (complete and sound):
        raise DataError(f"'{path}' is stored in other chunks than its filters make; it is damaged")
