"""A headless Chromium, driven by Selenium: tabs, sizes, screenshots, console errors, signals."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from eitskin.errors import ConfigurationError, EitskinError
from eitskin.extras import require

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
FLAGS = (
    "--headless=new",
    "--no-sandbox",  # which root, in a container, cannot have
    "--no-first-run",
    "--disable-background-networking",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--enable-unsafe-swiftshader",  # WebGL without a graphics card
    "--disable-gpu",
)
ANSWERS_WITHIN = 300.0  # s


class BrowserError(EitskinError):
    """The browser refused a command, or has gone."""


@dataclass(frozen=True, slots=True)
class Size:
    """Size of a page in CSS pixels; a phone has touch and finer pixels."""

    width: int
    height: int
    phone: bool = False


@dataclass(frozen=True, slots=True)
class Browser:
    """One Chromium process with its Selenium driver."""

    driver: Any

    def open(self, url: str, size: Size) -> "Tab":
        """Open `url` in a new window of that size."""
        self.driver.switch_to.new_window("window")
        tab = Tab(self.driver, self.driver.current_window_handle)
        tab.resize(size)
        self.driver.get(url)
        return tab

    def console_errors(self, url: str) -> list[str]:
        """Console errors and uncaught exceptions of pages at `url` since the last call."""
        return [
            entry["message"]
            for entry in self.driver.get_log("browser")
            if entry["level"] == "SEVERE" and entry["message"].startswith(url)
        ]


@dataclass(frozen=True, slots=True)
class Tab:
    """One page in a browser."""

    driver: Any
    handle: str

    def run(self, script: str) -> Any:
        """Value of a JavaScript expression, awaited if it is a promise; raises BrowserError."""
        from selenium.common.exceptions import WebDriverException

        self.driver.switch_to.window(self.handle)
        try:
            found = self.driver.execute_async_script(
                "const done = arguments[0];"
                f" (async () => {script})().then(value => done({{value}}),"
                " error => done({error: `${error}`}));"
            )
        except WebDriverException as error:
            raise BrowserError(f"{script}: {error.msg}") from error
        if "error" in found:
            raise BrowserError(f"{script}: {found['error']}")
        return found.get("value")

    def until(self, condition: str, seconds: float = ANSWERS_WITHIN) -> None:
        """Wait until a JavaScript expression is true; raises BrowserError.

        While the page loads the expression may throw, which counts as false.
        """
        from selenium.common.exceptions import TimeoutException
        from selenium.webdriver.support.wait import WebDriverWait

        true = f"(() => {{ try {{ return !!({condition}) }} catch {{ return false }} }})()"
        try:
            WebDriverWait(self.driver, seconds, poll_frequency=0.02).until(lambda _: self.run(true))
        except TimeoutException as error:
            raise BrowserError(f"{condition} did not become true in {seconds:g} s") from error

    def resize(self, size: Size) -> None:
        """Give the page another size."""
        self.driver.switch_to.window(self.handle)
        metrics = {
            "width": size.width,
            "height": size.height,
            "deviceScaleFactor": 2 if size.phone else 1,
            "mobile": size.phone,
        }
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        touch = {"enabled": size.phone}
        self.driver.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", touch)

    def screenshot(self, path: Path) -> None:
        """Write a PNG of the visible page."""
        self.driver.switch_to.window(self.handle)
        path.write_bytes(self.driver.get_screenshot_as_png())

    def close(self) -> None:
        """Close the window."""
        self.driver.switch_to.window(self.handle)
        self.driver.close()


@contextmanager
def chromium() -> Iterator[Browser]:
    """Run a Chromium with a new profile; raises ConfigurationError where there is none."""
    webdriver = require("selenium.webdriver", "dev")
    program = next(filter(None, map(shutil.which, NAMES)), None)
    driver_program = shutil.which("chromedriver")
    if program is None or driver_program is None:
        raise ConfigurationError(
            f"no browser found among {', '.join(NAMES)}, or no chromedriver; install both, on "
            "Debian with apt-get install chromium chromium-driver"
        )
    options = webdriver.ChromeOptions()
    options.binary_location = program
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    for flag in FLAGS:
        options.add_argument(flag)
    driver = webdriver.Chrome(options, webdriver.ChromeService(driver_program))
    driver.set_script_timeout(ANSWERS_WITHIN)
    try:
        yield Browser(driver)
    finally:
        driver.quit()
