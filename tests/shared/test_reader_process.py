"""Readers in a process of their own: what they answer, and every way in which they end."""

import os
import signal

import numpy as np
import pytest

from eitskin.errors import ConfigurationError, DataError
from eitskin.reader_process import Limits, read_in_subprocess

LIMITS = Limits(seconds=1, memory=100 << 20)


def answers(code, content=b"", limits=LIMITS):
    """Answers of a reader whose body is `code`."""
    return list(read_in_subprocess("builtin_reader:read", code, content, limits))


@pytest.fixture(autouse=True, scope="module")
def reader(tmp_path_factory):
    """A module with a reader that executes its argument, on the path of children."""
    folder = tmp_path_factory.mktemp("readers")
    body = (
        "import os, signal\nimport numpy as np\n"
        "from eitskin.reader_process import Answer\n"
        "from eitskin.errors import ConfigurationError, DataError\n"
        "def read(argument, content):\n    yield from eval(argument)\n"
        "def spin():\n    while True:\n        pass\n"
        "def fail(error):\n    raise error\n"
    )
    (folder / "builtin_reader.py").write_text(body)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(folder))
        from eitskin import reader_process as module

        patch.setattr(module._Child, "_idle", [])
        yield
        for child in module._Child._idle:
            child.release(clean=False)


def test_a_child_is_used_again_and_answers_and_errors_come_back():
    first, second = (answers("[Answer(os.getpid())]")[0].data for _ in range(2))
    assert first == second != os.getpid()
    made = answers(
        "[Answer({'a': [1, None]}, {'b': np.arange(3) + 1j}), Answer(len(content))]", b"xy"
    )
    assert made[0].data == {"a": [1, None]}
    np.testing.assert_array_equal(made[0].arrays["b"], np.arange(3) + 1j)
    assert made[1].data == 2
    with pytest.raises(DataError, match="objects"):
        answers("[Answer(0, {'t': np.array([{}], dtype=object)})]")
    for kind in (ConfigurationError, DataError, ImportError):
        with pytest.raises(kind, match="why"):
            answers(f"fail({kind.__name__}('why'))")
    with pytest.raises(DataError, match="KeyError"):
        answers("fail(KeyError('why'))")


@pytest.mark.slow
def test_a_reader_that_dies_loops_or_fills_up_is_one_error():
    with pytest.raises(DataError, match=f"signal {int(signal.SIGSEGV)}"):
        answers("[os.kill(os.getpid(), signal.SIGSEGV)]")
    with pytest.raises(DataError, match="code 7"):
        answers("[os._exit(7)]")
    with pytest.raises(DataError, match="1 s of processor time"):
        answers("spin()")
    with pytest.raises(DataError, match="100 MB"):
        answers("[Answer(len(bytearray(1 << 30)))]")
    assert answers("[Answer(1)]")[0].data == 1


@pytest.mark.slow
def test_a_reader_that_is_left_is_ended():
    reading = read_in_subprocess(
        "builtin_reader:read", "(Answer(os.getpid()) for _ in range(9))", b"", LIMITS
    )
    left = next(reading).data
    reading.close()
    assert answers("[Answer(os.getpid())]")[0].data != left
