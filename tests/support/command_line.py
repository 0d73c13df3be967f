"""Run of the command line in the process of the test."""

import json
from functools import cache

from typer import testing

from eitskin.cli.main import app

# The program with all its commands takes 50 ms to put together: once is enough.
testing._get_command = cache(testing._get_command)


def run(*words, code=None):
    """Result of `eitskin WORDS`; errors other than a usage error or an exit code are raised.

    Where a code is given, it must end with that one.
    """
    ran = testing.CliRunner().invoke(app, [str(word) for word in words])
    if ran.exception is not None and not isinstance(ran.exception, SystemExit):
        raise ran.exception
    assert code in (None, ran.exit_code), ran.output
    return ran


def printed_json(*words):
    """Data that `eitskin WORDS --json --quiet` prints."""
    return json.loads(run(*words, "--json", "--quiet").stdout)
