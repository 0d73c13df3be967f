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

# Files that take longest come first, so that no worker is left alone with one of them at the end;
# the second is one that needs no table of presses, which the first has the time to solve.
LONGEST = (
    "cli/test_demo",
    "simulator/mechanics/test_axisymmetric_press",
    "benchmarks/test_bench",
    "project/test_gallery",
    "datasets/test_generate",
    "simulator/mechanics/test_press_3d",
    "cli/test_generate",
    "training/test_calibration",
    "benchmarks/test_stability",
    "simulator/view/test_vtu",
    "simulator/electrical/test_convergence",
    "simulator/view/test_scene_pictures",
    "geometry/test_delaunay",
)


def pytest_collection_modifyitems(items):
    """Long files first; else in their order."""
    ranks = {name: rank for rank, name in enumerate(LONGEST)}
    here = Path(__file__).parent
    items.sort(
        key=lambda item: ranks.get(
            item.path.relative_to(here).with_suffix("").as_posix(), len(LONGEST)
        )
    )


@pytest.fixture
def connection():
    """A board that is no board, for the live page."""
    from page_fakes import FakeConnection

    return FakeConnection()


@pytest.fixture
def page(connection):
    """The live page of that board."""
    from eitskin.cli.page.live_page import Page

    from page_fakes import DESIGN

    with Page(connection, DESIGN) as made:
        yield made
