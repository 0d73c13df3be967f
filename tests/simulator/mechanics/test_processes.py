"""Processes in which tables are solved: told when they die, and ended by Ctrl-C."""

import os
import signal

import pytest

from eitskin.errors import PartialError
from eitskin.simulator.mechanics.processes import processes


def test_a_process_that_dies_is_told_in_words() -> None:
    with pytest.raises(PartialError, match=r"__main__"), processes(2) as run:
        list(run(os._exit, [1]))


def test_ctrl_c_ends_a_process_at_once() -> None:
    """A pool would go on with the next table, for half a minute."""
    with pytest.raises(PartialError), processes(2) as run:
        list(run(signal.raise_signal, [signal.SIGINT] * 4))
