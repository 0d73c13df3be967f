"""Set-up shared by all tests."""

import gc
import os
import re
import warnings
from collections import Counter, deque
from pathlib import Path

import pytest
from hypothesis import settings

# As the command line does, and for torch too; here before the first test module loads them. Workers
# are processes of their own: more threads than cores only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Solved presses are kept between runs, apart from the user's own.
os.environ.setdefault("EITSKIN_CACHE", str(Path(__file__).parents[1] / ".pytest_cache" / "kernels"))

KEPT_MESHES = 8
ALL_SLOW = re.compile(r"^pytestmark = \[?pytest\.mark\.slow\b", re.MULTILINE)
# Examples take as long as a busy machine needs for them.
settings.register_profile("any machine", deadline=None)
settings.load_profile("any machine")


def pytest_addoption(parser):
    """One option beside those of pytest."""
    parser.addoption(
        "--processor-times", action="store_true", help="files and tests that take most, at the end"
    )


def pytest_configure(config):
    """Collect garbage seldom: many thousand objects of packages are looked through each time."""
    gc.set_threshold(20_000, 10, 10)
    if config.getoption("--processor-times"):
        from processor_times import ProcessorTimes

        config.pluginmanager.register(ProcessorTimes())


def pytest_collection_finish():
    """Leave what has been imported out of later collections of garbage."""
    gc.freeze()


def pytest_ignore_collect(collection_path, config):
    """Leave files unread whose tests are all slow, where slow ones are left out."""
    if config.option.markexpr == "not slow" and collection_path.suffix == ".py":
        return bool(ALL_SLOW.search(collection_path.read_text(encoding="utf-8"))) or None
    return None


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    """Every other worker collects from the end.

    Compiling the test files takes most of the time in a fresh clone: two workers meet in the
    middle, and each reads what the other has compiled.
    """
    report = yield
    worker = os.environ.get("PYTEST_XDIST_WORKER", "gw0")
    if int(worker.removeprefix("gw")) % 2 and isinstance(collector, pytest.Session | pytest.Dir):
        report.result.reverse()
    return report


def pytest_collection_modifyitems(items):
    """Files with slow tests first, those with most of them before the others.

    No worker is then left alone with one of them at the end. All workers must have one order; a
    process without others runs files as they are asked for.
    """
    if "PYTEST_XDIST_WORKER" not in os.environ:
        return
    slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: (-slow[item.path], item.path))


@pytest.fixture(scope="session", autouse=True)
def kept_meshes():
    """Meshes of the latest designs, kept as by whoever keeps a simulator of each."""
    from eitskin.simulator.electrical import sensor_impedances

    kept, found = deque(maxlen=KEPT_MESHES), sensor_impedances.model_family

    def keeping(*asked):
        family = found(*asked)
        if family in kept:
            kept.remove(family)
        kept.append(family)
        return family

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sensor_impedances, "model_family", keeping)
        yield


@pytest.fixture
def reads_here(monkeypatch):
    """Let recordings be read in the process of the test, without the half second of another's."""
    from eitskin.datasets.recordings import source

    def here(_, argument, content, __):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of libraries, as there
            yield from source.read_source(argument, content)

    monkeypatch.setattr(source, "read_in_subprocess", here)


@pytest.fixture(scope="session")
def sim():
    """The reference sensor on a fast mesh."""
    from eitskin import geometry, simulator

    return simulator.Simulator(geometry.SensorDesign.reference(), resolution="fast")


@pytest.fixture(scope="module")
def pipeline():
    """The reference pipeline that ships."""
    from eitskin.training import Pipeline

    return Pipeline.load("reference.eitmodel")


@pytest.fixture
def connection():
    """A board that is no board, for the live page."""
    from eitskin.hardware import Connection

    from page_fakes import staged_board

    return Connection(staged_board())


@pytest.fixture
def page(connection):
    """The live page of that board."""
    from eitskin.cli.page.live_page import LivePage

    from page_fakes import DESIGN

    with LivePage(connection, DESIGN) as made:
        yield made
