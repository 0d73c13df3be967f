"""The live page in a real browser: door, drawings, buttons, on a desktop and a phone."""

import dataclasses
import types
from contextlib import ExitStack, contextmanager

import numpy as np
import pytest

from eitskin.cli.page.access import Access, Tokens
from eitskin.cli.page.drawing import Region
from eitskin.cli.page.live_page import LivePage, recorded_moments
from eitskin.datasets import ShardWriter, State
from eitskin.errors import ConfigurationError
from eitskin.hardware import Connection, ReplayBoard
from eitskin.training import TouchEstimate

from chromium import Size, Tab, chromium
from live_fakes import Info
from page_fakes import (
    DESIGN,
    FakeEstimate,
    FakeSession,
    port_of,
    reading,
    staged_board,
)

pytestmark = pytest.mark.slow

DESKTOP, PHONE = Size(1280, 900), Size(390, 844, phone=True)
TOKENS = Tokens("view-" + 12 * "v", "command-" + 12 * "c")
NOTHING = FakeEstimate(touches=())
RING = 6  # radius of a found touch, pixels


@pytest.fixture(scope="module")
def browser():
    pytest.importorskip("selenium", reason="no selenium to drive a browser with (extra dev)")
    try:
        with chromium() as opened:
            yield opened
    except ConfigurationError as error:
        pytest.skip(str(error))


@pytest.fixture
def session():
    return FakeSession()


def task(progress, text, choices=(), place=None):
    known = {"name": "set up", "progress": progress, "text": text, "lines": ["taken: flat"]}
    over = progress not in ("working", "asking")
    return known | {"choices": choices, "place": place, "over": over}


@pytest.fixture
def served(connection, session):
    with LivePage(connection, DESIGN, session=session) as page:
        yield page


@contextmanager
def opened(browser, url, size=DESKTOP):
    first = browser.driver.current_window_handle
    tab = browser.open(url, size)
    try:
        yield tab
    finally:
        tab.close()
        browser.driver.switch_to.window(first)


def text(tab: Tab, name: str) -> str:
    return tab.run(f"document.getElementById({name!r}).textContent")


def show(page, tab, shown):
    """Publish a reading and wait until it is drawn."""
    page.publish(shown)
    tab.until(f"window.eitskin && eitskin.number === {shown.frame.number}")


def watched(tab):
    """Wait until the page's stream has begun: what came before is not sent."""
    tab.until("document.getElementById('board').textContent")


def test_a_token_opens_the_door_and_leaves_the_address(browser, connection, session):
    with LivePage(connection, DESIGN, access=Access(tokens=TOKENS), session=session) as page:
        with opened(browser, page.url) as tab:
            tab.until("!document.getElementById('door').hidden")
            assert tab.run("getComputedStyle(document.querySelector('main')).display") == "none"
            tab.run("(document.getElementById('token').value = 'wrong', "
                    "document.querySelector('#door button').click(), 1)")  # fmt: skip
            tab.until("document.getElementById('door-said').textContent.includes('whole address')")
            assert page.server.watching == 0
            tab.run(f"(document.getElementById('token').value = {TOKENS.view!r}, "
                    "document.querySelector('#door button').click(), 1)")  # fmt: skip
            watched(tab)
            assert tab.run("document.getElementById('asked').hidden")
            assert tab.run("document.getElementById('controls').hidden")
        with opened(browser, dict(page.invitations)["page, to view and command"]) as tab:
            watched(tab)
            assert tab.run("[location.href, document.cookie]") == [page.url, ""]
            assert not tab.run("document.getElementById('asked').hidden")
            show(page, tab, reading(3))


def recorded(folder, estimates):
    """Readings of a recording, one for each of these estimates, 0.3 s apart."""
    with ShardWriter(folder / "monday") as writer:
        for number, _ in enumerate(estimates):
            writer.append(dataclasses.replace(reading(number).frame, time=5.0 + 0.3 * number))
    pipeline = types.SimpleNamespace(process=lambda frame: estimates[frame.number])
    return recorded_moments(ReplayBoard(str(folder / "monday")), pipeline, DESIGN)


def white_at(tab, px, py):
    """Whether the overlay of the sheet is white at a pixel, that of the ring of a touch."""
    return tab.run(
        f"""(() => {{
        const canvas = document.getElementById('map');
        const ratio = canvas.width / canvas.getBoundingClientRect().width;
        const at = canvas.getContext('2d')
          .getImageData(({px} + {RING}) * ratio, ({py}) * ratio, 1, 1).data;
        return Math.min(at[0], at[1], at[2]) > 200 && at[3] > 200;
        }})()"""
    )


@pytest.mark.parametrize("size", [DESKTOP, PHONE])
def test_a_touch_is_drawn_where_the_estimate_has_it(browser, connection, session, size):
    sheet = Region((0.0, 0.0), (0.15, 0.06))
    with (
        LivePage(connection, sheet, session=session) as page,
        opened(browser, page.url, size) as tab,
    ):
        watched(tab)
        show(page, tab, reading(1, NOTHING))
        wide, high = tab.run("[eitskin.sheet.surface.width, eitskin.sheet.surface.height]")
        scale = min((wide - 44) / 0.15, (high - 44) / 0.06)
        for number, (x, y) in enumerate([(0.05, 0.031), (0.11, 0.02)], 2):
            place = wide / 2 + scale * (x - 0.075), high / 2 - scale * (y - 0.03)
            assert not white_at(tab, *place)
            found = FakeEstimate(touches=(TouchEstimate(x, y, 7.5, strength=0.9),))
            show(page, tab, reading(number, found))
            assert white_at(tab, *place)
            assert text(tab, "touches") == f"{1e3 * x:.0f}, {1e3 * y:.0f} mm:\u00a07.5\u00a0N"
        assert (text(tab, "angle"), text(tab, "total")) == ("+20.5°", "7.5 N")


def test_the_bent_sheet_shows_and_takes_touches_at_their_places(browser, served):
    bent = FakeEstimate(bend_angle_deg=40.0, touches=(TouchEstimate(0.11, 0.02, 7.5),))
    with opened(browser, served.url) as tab:
        watched(tab)
        before = tab.run("eitskin.updates")
        show(served, tab, reading(1, bent))
        assert tab.run("eitskin.updates") - before == 1  # drawn once
        assert white_at(tab, *tab.run("eitskin.sheet.view.project(0.11, 0.02)")[:2])
        for above in ("true", "false"):
            tab.run(f"eitskin.sheet.view.reset({above})")
            for x, y in [(0.01, 0.01), (0.075, 0.05), (0.14, 0.03)]:
                there = "eitskin.sheet.view.locate(...eitskin.sheet.view.project({}, {}))"
                found = tab.run(there.format(x, y))
                assert (found["x"], found["y"]) == pytest.approx((x, y), abs=2e-4)
        assert tab.run("eitskin.sheet.view.project(0.2, 0.02)") is None
        assert tab.run("eitskin.sheet.view.locate(1, 1)") is None


def test_text_of_boards_and_files_is_shown_as_text(browser, session):
    tag = "<script>window.broken = 1</script><img src=x onerror='window.broken = 1'>"
    board = staged_board(uri=f"replay:{tag}", info=Info(firmware=tag))
    session.task = task("working", tag)
    with (
        LivePage(Connection(board), DESIGN, session=session) as page,
        opened(browser, page.url) as tab,
    ):
        watched(tab)
        show(page, tab, reading(1, FakeEstimate(problems=(tag,))))
        page.tell()
        tab.until("document.getElementById('task-text').textContent.includes('script')")
        assert tag in text(tab, "board")
        assert text(tab, "problems") == tag
        assert tab.run("[window.broken ?? 0, document.querySelectorAll('img').length]") == [0, 0]


def test_earlier_moments_and_recordings_are_shown_again(browser, served, session, tmp_path):
    with opened(browser, served.url) as tab:
        watched(tab)
        show(served, tab, reading(1, NOTHING))
        show(served, tab, reading(2, FakeEstimate(state=State.IDLE, touches=())))
        lost = dataclasses.replace(reading(3, NOTHING).frame, status=np.r_[8, np.zeros(27)])
        show(served, tab, dataclasses.replace(reading(3, FakeEstimate()), frame=lost))
        events = tab.run("eitskin.timeline.source.events.map(({ text }) => text)")
        assert events == ["idle", "touch, 7.5 N", "channel 0-1: open"]
        tab.run("eitskin.timeline.choose(eitskin.timeline.source.events[0].time)")
        assert text(tab, "state") == "idle"
        assert "now" not in text(tab, "moment")
        show(served, tab, reading(4, FakeEstimate()))
        assert text(tab, "state") == "idle"  # still the moment that was chosen
        tab.run("document.getElementById('newest').click()")
        assert text(tab, "state") == "touch"
        session.readings = recorded(tmp_path, [FakeEstimate(bend_angle_deg=a) for a in (0.0, 9.0)])
        tab.run("document.getElementById('replay').click()")
        tab.until("document.getElementById('moment').textContent.includes('monday')")
        assert text(tab, "angle") == "0.0°"
        tab.run("eitskin.timeline.choose(1e3)")
        assert text(tab, "angle") == "+9.0°"
        tab.run("document.getElementById('pause').click()")  # play from the beginning
        tab.until("document.getElementById('moment').textContent.includes('0.3 s')")
        assert text(tab, "angle") == "+9.0°"
        assert not browser.console_errors(served.url)


def test_a_page_that_is_opened_late_shows_what_happened_before(browser, served, monkeypatch):
    monkeypatch.setattr("eitskin.cli.page.live_page.MEMORY_PACE", 0.0)
    idle = FakeEstimate(state=State.IDLE, touches=())
    with opened(browser, served.url) as tab:
        watched(tab)
        for number, estimate in enumerate((idle, FakeEstimate(), FakeEstimate()), 1):
            show(served, tab, reading(number, estimate))
        tab.run("location.reload()")
        tab.until("eitskin.timeline.source.events.length")
        events = tab.run("eitskin.timeline.source.events.map(({ text }) => text)")
        assert events == ["touch, 7.5 N"]


def test_buttons_ask_the_session_and_its_task_is_shown(browser, served, session):
    with opened(browser, served.url) as tab:
        watched(tab)
        show(served, tab, reading(1, NOTHING))
        for path in ("/tare", "/check", "/setup"):
            tab.run(f"document.querySelector('[data-path=\"{path}\"]').click()")
            assert session.pressed() == (path, "{}")
        tab.run("document.getElementById('record').click()")
        assert session.pressed() == ("/record", '{"record":true}')
        session.task = task("asking", "press at 1", [("", "it is so"), ("s", "skip")], (0.05, 0.03))
        served.tell()
        tab.until("document.querySelectorAll('#choices button').length === 2")
        assert text(tab, "task-text") == "press at 1"
        assert tab.run("document.querySelector('[data-path=\"/tare\"]').disabled")
        tab.run("document.querySelectorAll('#choices button')[1].click()")
        assert session.pressed() == ("/answer", '{"answer":"s"}')
        tab.run("document.getElementById('cancel').click()")
        assert session.pressed() == ("/cancel", "{}")
        session.task = task("failed", "expected a still sensor")
        served.tell()
        tab.until("document.getElementById('task-name').textContent === 'set up: failed'")
        assert not tab.run("document.querySelector('[data-path=\"/tare\"]').disabled")


def test_it_comes_back_after_the_board_and_after_the_server(browser, connection):
    with ExitStack() as stack:
        with LivePage(connection, DESIGN) as page:
            port = port_of(page)
            tab = stack.enter_context(opened(browser, page.url))
            watched(tab)
            show(page, tab, reading(1))
            tab.until("document.body.dataset.link === 'live'")
            connection.problem = "the cable was pulled"
            page.tell()
            tab.until("document.body.dataset.link === 'stale'")
            assert "the cable was pulled" in text(tab, "problems")
            connection.problem = ""
            show(page, tab, reading(2))
            assert tab.run("document.body.dataset.link") == "live"
        tab.until("document.body.dataset.link === 'lost'")
        page = stack.enter_context(LivePage(Connection(staged_board()), DESIGN, port=port))
        while not page.server.watching:
            tab.run("1")
        show(page, tab, reading(3))
        assert tab.run("document.body.dataset.link") == "live"


def test_a_phone_scrolls_in_one_direction(browser, served, session):
    long = "page-files/recording-" + 40 * "0123456789"
    session.task = task("asking", long, [("", "go on"), ("r", "repeat")], (0.1, 0.03))
    crowded = FakeEstimate(
        touch_map=np.random.default_rng(0).random((32, 80)), problems=(long, "another")
    )
    for size in (PHONE, Size(320, 568, phone=True), Size(844, 390, phone=True)):
        with opened(browser, served.url, size) as tab:
            watched(tab)
            show(served, tab, reading(size.width, crowded))
            wide = tab.run("[document.documentElement.scrollWidth, window.innerWidth]")
            assert wide == [size.width, size.width]
            assert not browser.console_errors(served.url)
