"""Context manager protocol of everything with `close`."""

from types import TracebackType
from typing import Self


class Closeable:
    """Base class that makes an object with `close` a context manager."""

    def close(self) -> None:
        """Release files, ports and threads; a second call does nothing."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the object, with or without an error in the block."""
        self.close()
