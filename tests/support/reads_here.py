"""Recordings read in the process of the test, where the reader's own is not tried."""

import io
import warnings
from importlib import import_module

from eitskin.errors import ConfigurationError, DataError
from eitskin.reader_process import read_message, write_message


def read_here(reader, argument, content, limits):  # noqa: ARG001
    """As `read_in_subprocess`, without the half second that each process takes to load."""
    module, _, function = reader.partition(":")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of libraries, which nobody hears of the process
        try:
            for answer in getattr(import_module(module), function)(argument, content):
                sent = io.BytesIO()
                write_message(sent, answer.data, answer.arrays)
                sent.seek(0)
                yield read_message(sent)
        except (ConfigurationError, DataError, ImportError):
            raise
        except Exception as error:
            raise DataError(f"it cannot be read: {type(error).__name__}: {error}") from error
