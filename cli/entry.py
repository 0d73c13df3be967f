"""Entry point of the `eitskin` program, the outer boundary of all errors.

Ctrl-C while the program loads is answered here, and so is every exception that no command expected.
"""

import errno
import os
import sys

EXIT_UNEXPECTED = 70  # EX_SOFTWARE of sysexits.h
EXIT_INTERRUPTED = 130
EXIT_PARTIAL = 5  # as of `PartialError`
_FULL = (errno.ENOSPC, errno.EDQUOT)  # of a disk; who writes files names them in other errors
_QUIET = "ignore::RuntimeWarning"


def run() -> None:
    """Run the command of `sys.argv`; `eitskin.cli.main` has the exit codes.

    An unexpected exception ends it with exit code 70, one sentence, and a report in a file.
    """
    _silence_numbers()
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
        from eitskin.cli.failure_report import told

        sys.stderr.write(told(error))
        sys.exit(EXIT_UNEXPECTED)


def _silence_numbers() -> None:
    """Keep warnings of NumPy about single operations off the terminal, in workers too.

    Results are checked where they leave a function. `python -W` and PYTHONWARNINGS go before.
    """
    if not sys.warnoptions:
        import warnings

        warnings.filterwarnings("ignore", category=RuntimeWarning)
        os.environ.setdefault("PYTHONWARNINGS", _QUIET)
