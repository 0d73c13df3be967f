"""Cache of compiled kernels on disk: a file that is damaged counts as missing.

numba unpickles what it keeps and runs it as machine code, so a file cut short by a full disk, or
with one bit turned, would end the process that loads it. Here every file ends in its checksum.
Where the cache cannot be used, read or written, kernels are compiled in each process.
"""

import hashlib
import pickle
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from numba.core.caching import FunctionCache, IndexDataCacheFile  # noqa: TID253 (loaded late)
from numba.core.serialize import dumps  # noqa: TID253

from eitskin.errors import ConfigurationError
from eitskin.files import read_bytes

DIGEST = hashlib.sha256().digest_size
MAX_SIZE = 64 << 20  # of a compiled kernel [bytes]; the largest has 0.3 MB


def use_cache(dispatcher: Any, function: Callable[..., object]) -> None:
    """Let a numba dispatcher of `function`, not yet compiled, keep its code on disk."""
    with suppress(OSError, RuntimeError):  # numba finds no folder that can be written
        dispatcher._cache = _CheckedCache(function)


class _CheckedCache(FunctionCache):
    """Cache of one function whose files are checked."""

    def __init__(self, function: Callable[..., object]) -> None:
        super().__init__(function)
        self._cache_file = _CheckedFiles(
            self._cache_path, self._impl.filename_base, self._impl.locator.get_source_stamp()
        )

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save compiled code, as far as the disk allows."""
        with suppress(OSError):
            super().save_overload(sig, data)


class _CheckedFiles(IndexDataCacheFile):
    """Index and code of one function, each file followed by its checksum."""

    def _load_index(self) -> dict[Any, str]:
        with suppress(OSError):
            version, stamp, names = self._load(self._index_path)
            if (version, stamp) == (self._version, self._source_stamp):
                return dict(names)
        return {}

    def _save_index(self, overloads: dict[Any, str]) -> None:
        self._save(self._index_path, (self._version, self._source_stamp, overloads))

    def _load_data(self, name: str) -> Any:
        return self._load(self._data_path(name))

    def _save_data(self, name: str, data: Any) -> None:
        self._save(self._data_path(name), data)

    def _load(self, path: str) -> Any:
        """Object in a file; FileNotFoundError where it is not whole."""
        try:
            content = read_bytes(Path(path), MAX_SIZE)
        except ConfigurationError as error:
            raise FileNotFoundError(path) from error
        body, digest = content[:-DIGEST], content[-DIGEST:]
        if hashlib.sha256(body).digest() != digest:
            raise FileNotFoundError(path)
        return pickle.loads(body)  # noqa: S301 (the user's own cache, as numba reads it)

    def _save(self, path: str, data: Any) -> None:
        body = dumps(data)
        with self._open_for_write(path) as file:
            file.write(body + hashlib.sha256(body).digest())
