"""Exception classes and exit codes of eitskin.

    EitskinError
    +-- ConfigurationError   an invalid design, scene, recipe or option; exit code 2
    +-- DataError            an unusable dataset, recording or saved pipeline; exit code 3
    |   +-- FrameError       a frame of another protocol, shape or frequency
    |       +-- UnusableFrameError   of the right sensor, but too damaged; the next may be good
    +-- DeviceError          a board that is absent, silent or speaks otherwise; exit code 4
    +-- PartialError         work that stopped part-way and can be resumed; exit code 5

Every message says what was expected, what was given, and the remedy.
"""

MAX_MESSAGE = 4000
"""Characters of a message at most, so that no file fills the terminal with what it holds."""


def cut(message: str) -> str:
    """Message without its middle where it is too long."""
    if len(message) <= MAX_MESSAGE:
        return message
    half = MAX_MESSAGE // 2
    return f"{message[:half]} ... {message[-half:]}"


class EitskinError(Exception):
    """Base class of all errors that eitskin raises on purpose; long messages lose their middle.

    Example:
        >>> from eitskin.geometry import DataError, EitskinError
        >>> issubclass(DataError, EitskinError)
        True
    """

    exit_code = 1

    def __str__(self) -> str:
        return cut(super().__str__())


class ConfigurationError(EitskinError, ValueError):
    """An invalid design, scene, recipe or option.

    Example:
        >>> from eitskin.geometry import ConfigurationError, Disc
        >>> try:
        ...     Disc(-1.0)
        ... except ConfigurationError as error:
        ...     print(error.exit_code)
        2
    """

    exit_code = 2


class DataError(EitskinError, ValueError):
    """An unusable dataset, recording or saved pipeline.

    Example:
        >>> from eitskin.datasets import open_dataset
        >>> from eitskin.geometry import DataError
        >>> try:
        ...     open_dataset("nowhere")
        ... except DataError as error:
        ...     print(error.exit_code)
        3
    """

    exit_code = 3


class FrameError(DataError):
    """A frame of another protocol, shape or frequency than the one expected.

    Example:
        >>> from eitskin.geometry import DataError, FrameError
        >>> issubclass(FrameError, DataError)
        True
    """


class UnusableFrameError(FrameError):
    """A frame of the right sensor with too few good values; the next one may be good.

    Example:
        >>> from eitskin.geometry import FrameError, UnusableFrameError
        >>> issubclass(UnusableFrameError, FrameError)
        True
    """


class DeviceError(EitskinError, OSError):
    """A board that is absent, silent, or speaks another protocol.

    Example:
        >>> from eitskin.geometry import DeviceError
        >>> DeviceError("no board").exit_code
        4
    """

    exit_code = 4


class PartialError(EitskinError):
    """Work that stopped part-way; finished files are kept and the work can be resumed.

    Example:
        >>> from eitskin.geometry import PartialError
        >>> PartialError("disk full").exit_code
        5
    """

    exit_code = 5
