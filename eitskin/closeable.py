"""What must be closed when a `with` statement ends."""

from types import TracebackType
from typing import Self


class Closeable:
    """Gives `close` the two methods that make it part of a `with` statement."""

    def close(self) -> None:
        """Let go of what is held; a second time does nothing."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close it, whatever happened."""
        self.close()
