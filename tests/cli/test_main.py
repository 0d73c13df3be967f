"""The program as a whole: version, completion, what is loaded, and errors that none expects."""

import errno
import os
import re
import signal
import subprocess
import sys
from importlib.metadata import version

import click
import pytest

from eitskin.cli import entry, main
from eitskin.cli.options import ended_by_signals
from eitskin.errors import DataError, PartialError

HEAVY = {"h5py", "matplotlib", "numpy", "pyvista", "scipy", "serial", "skfem", "torch"}


def eitskin(*arguments, **environment):
    command = [sys.executable, "-m", "eitskin", *arguments]
    return subprocess.run(
        command, env=os.environ | environment, capture_output=True, text=True, check=True
    ).stdout


@pytest.mark.slow
def test_version():
    assert eitskin("--version") == f"eitskin {version('eitskin')}\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "expected"),
    [("eitskin si", {"simulate"}), ("eitskin simulate --se", {"--sensor", "--seed"})],
)
def test_bash_completes_commands_and_options(words, expected):
    code = "import sys; sys.argv[0] = 'eitskin'; from eitskin.cli.main import run; run()"
    asked = {"COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    said = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | asked | {"_EITSKIN_COMPLETE": "complete_bash"},
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    ).stdout
    assert set(said.split()) == expected


@pytest.mark.slow
def test_heavy_packages_are_loaded_by_commands_only():
    code = "import sys, eitskin.cli.main; print(*{name.partition('.')[0] for name in sys.modules})"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    assert HEAVY.isdisjoint(loaded)


def ended(monkeypatch, tmp_path, error, *words):
    """Exit code of the program whose command raises `error`."""

    def raising():
        raise error

    monkeypatch.setattr(main, "app", lambda **_: raising())
    monkeypatch.setattr("sys.argv", ["eitskin", *words])
    monkeypatch.setattr("sys.warnoptions", ["default"])
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(SystemExit) as ending:
        entry.run()
    return ending.value.code


def test_an_unexpected_exception_is_one_sentence_and_a_report(monkeypatch, tmp_path, capsys):
    error = KeyError("secret " * 1000)
    assert ended(monkeypatch, tmp_path, error, "train", "a file") == entry.EXIT_UNEXPECTED
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "Traceback" not in said
    (path,) = tmp_path.iterdir()
    assert str(path) in said
    written = path.read_text()
    assert "command: eitskin train 'a file'" in written
    assert "KeyError" in written
    assert max(map(len, written.splitlines())) <= 300
    monkeypatch.undo()
    assert ended(monkeypatch, tmp_path / "none", RuntimeError("x")) == entry.EXIT_UNEXPECTED
    assert re.search(r"RuntimeError.* in raising, line \d+", capsys.readouterr().err)


def test_memory_or_a_disk_that_ends_is_no_fault_of_the_program(monkeypatch, tmp_path, capsys):
    assert ended(monkeypatch, tmp_path, MemoryError()) == entry.EXIT_UNEXPECTED
    assert "memory" in capsys.readouterr().err
    full = OSError(errno.ENOSPC, "No space left on device")
    assert ended(monkeypatch, tmp_path, full) == PartialError.exit_code
    assert "No space left on device; make room" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_sigterm_is_told_as_ctrl_c_by_every_command(capsys):
    stop = click.Command("stop", callback=lambda: os.kill(os.getpid(), signal.SIGTERM))
    group = main.Program(name="eitskin", commands={"stop": stop})
    assert group.main(["stop"], standalone_mode=False) == entry.EXIT_INTERRUPTED
    assert "interrupted" in capsys.readouterr().err


def test_messages_neither_control_the_terminal_nor_fill_it(monkeypatch, tmp_path, capsys):
    hostile = DataError("\x1b]0;owned\x07" + "x" * 100_000 + "\nremedy")
    assert ended(monkeypatch, tmp_path, hostile) == DataError.exit_code
    said = capsys.readouterr().err
    assert "\\x1b]0;owned\\x07" in said
    assert said.endswith("\nremedy\n")
    assert len(said) < 5000


def struck(cause):
    """Compiled code that was struck by a signal, or failed otherwise."""
    with ended_by_signals():
        raise SystemError("returned a result with an exception set") from cause


def test_an_interrupt_of_compiled_code_is_an_interrupt():
    with pytest.raises(KeyboardInterrupt):
        struck(KeyboardInterrupt())
    with pytest.raises(SystemError):
        struck(ValueError())
