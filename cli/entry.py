"""Entry point of the `eitskin` program, the outer boundary of all errors.

Ctrl-C while the program loads is answered here, and so is every exception that no command expected.
"""

import errno
import gc
import os
import signal
import sys
import threading

EXIT_INPUT = 2  # as of `ConfigurationError`
EXIT_UNEXPECTED = 70  # EX_SOFTWARE of sysexits.h
EXIT_INTERRUPTED = 130
EXIT_PARTIAL = 5  # as of `PartialError`
_FULL = (errno.ENOSPC, errno.EDQUOT)  # of a disk; who writes files names them in other errors
_PATHS = (errno.ENAMETOOLONG, errno.ENOTDIR, errno.ELOOP, errno.EACCES, errno.EPERM, errno.EROFS)
_QUIET = "ignore::RuntimeWarning"
_PACKAGES = ("h5py", "msgspec", "numpy", "safetensors", "scikit-fem", "scipy", "torch")
_MAX_LINE = 300  # characters; the message of an exception may quote a file


def run() -> None:
    """Run the command of `sys.argv`; `eitskin.cli.main` has the exit codes.

    An unexpected exception ends it with exit code 70, one sentence, and a report in a file.
    """
    gc.set_threshold(20_000, 10, 10)  # imports make many objects, and hardly one is garbage
    _silence_numbers()
    sys.unraisablehook = interrupt_again
    try:
        from eitskin.cli import main

        main.run()
    except KeyboardInterrupt:
        sys.stderr.write("eitskin: interrupted\n")
        sys.exit(EXIT_INTERRUPTED)
    except Exception as error:  # the one place that may catch everything
        if isinstance(error, OSError) and error.errno in _FULL:
            sys.stderr.write(f"eitskin: cannot write the output: {error.strerror}; make room\n")
            sys.exit(EXIT_PARTIAL)
        if isinstance(error, OSError) and error.errno in _PATHS and error.filename is not None:
            from eitskin.files import quote_value

            text = f"cannot use {quote_value(error.filename)}: {error.strerror}; name another path"
            sys.stderr.write(f"eitskin: {text}\n")
            sys.exit(EXIT_INPUT)
        sys.stderr.write(describe_failure(error))
        sys.exit(EXIT_UNEXPECTED)


def interrupt_again(ignored: "sys.UnraisableHookArgs") -> None:
    """Raise a Ctrl-C again that Python ignores, since it struck the callback of a weak reference.

    Other exceptions that are ignored are printed.
    """
    if not isinstance(ignored.exc_value, KeyboardInterrupt):
        sys.__unraisablehook__(ignored)
        return
    signal.signal(signal.SIGINT, signal.default_int_handler)
    again = threading.main_thread().ident, signal.SIGINT
    threading.Timer(0.05, signal.pthread_kill, again).start()  # when the callback has ended


def _silence_numbers() -> None:
    """Keep warnings of NumPy about single operations off the terminal, in workers too.

    Results are checked where they leave a function. `python -W` and PYTHONWARNINGS go before.
    """
    if not sys.warnoptions:
        import warnings

        warnings.filterwarnings("ignore", category=RuntimeWarning)
        os.environ.setdefault("PYTHONWARNINGS", _QUIET)


def describe_failure(error: Exception) -> str:
    """Sentence about an unexpected exception, whose report is written.

    Memory that ends is a fault of the input or of the machine, and needs no report.
    """
    if isinstance(error, MemoryError):
        return (
            "eitskin: the memory is not enough; ask for less, such as a smaller file, mesh or "
            "dataset, or fewer workers\n"
        )
    import tempfile
    import traceback

    try:
        handle, name = tempfile.mkstemp(prefix="eitskin-report-", suffix=".txt")
        with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
            file.write(failure_report(error))
        place = f"; please send {name}, after a look at what it says"
    except OSError:
        last = traceback.extract_tb(error.__traceback__)[-1]
        place = f", in {last.name}, line {last.lineno}; no report could be written"
    return f"eitskin: this is a bug in eitskin ({type(error).__name__}){place}\n"


def failure_report(error: Exception) -> str:
    """Text of a report: versions, the command, and where the exception was raised.

    Files are named as the command names them; their content is not in it but for what messages
    quote, which is cut.
    """
    import platform
    import shlex
    import traceback
    from datetime import UTC, datetime

    from eitskin import __version__
    from eitskin.files import printable
    from eitskin.provenance import package_versions

    lines = [
        f"eitskin {__version__}, {datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        f"Python {platform.python_version()}, {platform.platform()}",
        ", ".join(" ".join(item) for item in package_versions(_PACKAGES).items()),
        f"command: eitskin {shlex.join(sys.argv[1:])}",
        "",
        *"".join(traceback.format_exception(error)).splitlines(),
    ]
    return "\n".join(printable(line[:_MAX_LINE]) for line in lines) + "\n"
