"""The `eitskin` program: loads the commands, and says so where Ctrl-C ends that."""

import sys

EXIT_INTERRUPTED = 130


def run() -> None:
    """Run the command that was typed; `eitskin.cli.main` has the exit codes."""
    try:
        from eitskin.cli import main

        main.run()
    except KeyboardInterrupt:
        sys.stderr.write("eitskin: interrupted\n")
        sys.exit(EXIT_INTERRUPTED)
