"""The errors that eitskin raises, drawn once.

    EitskinError
    +-- ConfigurationError   a design, scene, recipe or option that cannot be; exit code 2
    +-- DataError            a dataset, recording or saved pipeline that cannot be used; exit code 3
    |   +-- FrameError       a frame that this pipeline cannot use
    |       +-- UnusableFrameError   of the right sensor, but too damaged; the next may be good
    +-- DeviceError          a board that is absent, silent or speaks otherwise; exit code 4
    +-- PartialError         work that stopped part-way and can be resumed; exit code 5

Every message says what was expected, what came, and what to do.
"""


class EitskinError(Exception):
    """Base of everything that eitskin raises on purpose."""

    exit_code = 1


class ConfigurationError(EitskinError, ValueError):
    """A design, scene, recipe or option that cannot be."""

    exit_code = 2


class DataError(EitskinError, ValueError):
    """A dataset, recording or saved pipeline that cannot be used."""

    exit_code = 3


class FrameError(DataError):
    """A frame of another protocol, shape or frequency than the one expected."""


class UnusableFrameError(FrameError):
    """A frame of the right sensor with too few good values; the next one may be good."""


class DeviceError(EitskinError, OSError):
    """A board that is absent, silent, or speaks another protocol."""

    exit_code = 4


class PartialError(EitskinError):
    """Work that stopped part-way; what is finished is kept and the work can be resumed."""

    exit_code = 5
