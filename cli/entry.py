"""Entry point of the `eitskin` program, with a message for Ctrl-C while it loads."""

import sys

EXIT_INTERRUPTED = 130


def run() -> None:
    """Run the command of `sys.argv`; `eitskin.cli.main` has the exit codes."""
    try:
        from eitskin.cli import main

        main.run()
    except KeyboardInterrupt:
        sys.stderr.write("eitskin: interrupted\n")
        sys.exit(EXIT_INTERRUPTED)
