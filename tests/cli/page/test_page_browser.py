"""The live page in a real browser: door, drawings, buttons, on a desktop and a phone."""

from contextlib import ExitStack, contextmanager

import numpy as np
import pytest

from eitskin.cli.page.access import Access, Tokens
from eitskin.cli.page.live_page import LivePage
from eitskin.errors import ConfigurationError
from eitskin.training.method.predictions import TouchEstimate

from chromium import Size, Tab, chromium
from page_fakes import DESIGN, FakeConnection, FakeEstimate, FakeSession, port_of, reading

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


def white_at(tab, x, y):
    """Whether the map is white at the ring of a touch at (x, y) [m], by a formula of its own."""
    return tab.run(
        f"""(() => {{
        const canvas = document.getElementById('map'), shown = canvas.getBoundingClientRect();
        const scale = Math.min((shown.width - 44) / 0.15, (shown.height - 44) / 0.06);
        const px = shown.width / 2 + scale * ({x} - 0.075) + {RING};
        const py = shown.height / 2 - scale * ({y} - 0.03);
        const ratio = canvas.width / shown.width;
        const at = canvas.getContext('2d').getImageData(px * ratio, py * ratio, 1, 1).data;
        return Math.min(at[0], at[1], at[2]) > 200;
        }})()"""
    )


@pytest.mark.parametrize("size", [DESKTOP, PHONE])
def test_a_touch_is_drawn_where_the_estimate_has_it(browser, served, size):
    with opened(browser, served.url, size) as tab:
        watched(tab)
        show(served, tab, reading(1, NOTHING))
        for number, (x, y) in enumerate([(0.05, 0.031), (0.11, 0.02)], 2):
            assert not white_at(tab, x, y)
            found = FakeEstimate(touches=(TouchEstimate(x, y, 7.5, strength=0.9),))
            show(served, tab, reading(number, found))
            assert white_at(tab, x, y)
            assert text(tab, "touches") == f"{1e3 * x:.0f}, {1e3 * y:.0f} mm: 7.5 N"
        assert text(tab, "angle") == "+20.5°"


def test_every_reading_that_is_waited_for_is_drawn_once(browser, served):
    with opened(browser, served.url) as tab:
        watched(tab)
        before = tab.run("eitskin.updates")
        for number in range(1, 31):
            show(served, tab, reading(number))
        assert tab.run("eitskin.updates") - before == 30


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
        page = stack.enter_context(LivePage(FakeConnection(), DESIGN, port=port))
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
