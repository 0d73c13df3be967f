"""The command line, as `python -m eitskin`."""

from eitskin.cli.entry import run

if __name__ == "__main__":
    run()
