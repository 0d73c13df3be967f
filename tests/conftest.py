"""Set-up shared by all tests."""

import os
from pathlib import Path

import pytest

# As the command line does, and for torch too; here before the first test module loads them. Workers
# are processes of their own: more threads than cores only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Solved presses are kept between runs, apart from the user's own.
os.environ.setdefault("EITSKIN_CACHE", str(Path(__file__).parents[1] / ".pytest_cache" / "kernels"))


def pytest_addoption(parser):
    """How often `tests/datasets/test_crashes.py` kills and starves a run; 200 for the long run."""
    parser.addoption("--crashes", type=int, default=1, help="trials of each kind of crash")


def pytest_collection_modifyitems(items):
    """Files with slow tests first, so that no worker is left alone with one of them at the end."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


@pytest.fixture
def connection():
    """A board that is no board, for the live page."""
    from page_fakes import FakeConnection

    return FakeConnection()


@pytest.fixture
def page(connection):
    """The live page of that board."""
    from eitskin.cli.page.live_page import LivePage

    from page_fakes import DESIGN

    with LivePage(connection, DESIGN) as made:
        yield made
