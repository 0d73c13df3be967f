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

LONGEST_MESSAGE = 4000
"""Characters of a message at most, so that no file fills the terminal with what it holds."""


def cut(message: str) -> str:
    """Message without its middle where it is too long."""
    if len(message) <= LONGEST_MESSAGE:
        return message
    half = LONGEST_MESSAGE // 2
    return f"{message[:half]} ... {message[-half:]}"


class EitskinError(Exception):
    """Base class of all errors that eitskin raises on purpose; long messages lose their middle."""

    exit_code = 1

    def __str__(self) -> str:
        return cut(super().__str__())


class ConfigurationError(EitskinError, ValueError):
    """An invalid design, scene, recipe or option."""

    exit_code = 2


class DataError(EitskinError, ValueError):
    """An unusable dataset, recording or saved pipeline."""

    exit_code = 3


class FrameError(DataError):
    """A frame of another protocol, shape or frequency than the one expected."""


class UnusableFrameError(FrameError):
    """A frame of the right sensor with too few good values; the next one may be good."""


class DeviceError(EitskinError, OSError):
    """A board that is absent, silent, or speaks another protocol."""

    exit_code = 4


class PartialError(EitskinError):
    """Work that stopped part-way; finished files are kept and the work can be resumed."""

    exit_code = 5
