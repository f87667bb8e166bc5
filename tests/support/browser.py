"""Debian's chromium without a window, through Selenium: its pages, what their consoles said, and
pictures of them.
"""

from __future__ import annotations

import itertools
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from selenium.webdriver import Chrome, ChromeOptions
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By
from selenium.webdriver.remote.webelement import WebElement
from selenium.webdriver.support.ui import WebDriverWait

from tests.support.waiting import PATIENCE_S

FLAGS = (
    "--headless=new",
    "--no-sandbox",  # chromium refuses its own as root, which a container's user is
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
)
# Beside what may be scrolled: the row of overlays, wide tables, the bench file, tables of events.
OVERFLOWING = """
const may = (element) => element.closest("#overlays, .wide-table, pre, canvas, .skip, dialog");
const wide = (element) => !element.childElementCount && element.clientWidth && element.scrollWidth > element.clientWidth + 1;
return [...document.querySelectorAll("body *")]
  .filter((element) => element.checkVisibility() && !may(element))
  .filter((element) => element.getBoundingClientRect().right > innerWidth + 0.5 || wide(element))
  .map((element) => `${element.tagName} ${element.id} ${element.className}: ${element.textContent.slice(0, 40)}`);
"""
SIZES_PX = {"phone": (390, 844), "laptop": (1366, 768), "large": (1920, 1080)}


DARK, LIGHT = 40, 200  # grey values that no theme is between


class Browser(Chrome):
    """A browser with what the tests of pages need."""

    def start_session(self, capabilities: dict[str, Any]) -> None:
        """Begin, however long a busy machine takes to."""
        self.command_executor.client_config.timeout = PATIENCE_S
        super().start_session(capabilities)

    def size(self, width_px: int, height_px: int) -> None:
        """The size of the page's window, in CSS pixels, however small."""
        metrics = {"width": width_px, "height": height_px, "deviceScaleFactor": 1, "mobile": False}
        self.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)

    def prefer(self, **features: str) -> None:
        """What the user's system asks for: color_scheme="light", reduced_motion="reduce"."""
        asked = [
            {"name": f"prefers-{name.replace('_', '-')}", "value": value}
            for name, value in features.items()
        ]
        self.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": asked})

    def paper(self) -> None:
        """The page as it is printed, until `screen`; the page is told, as by printing."""
        self.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
        self.run("window.dispatchEvent(new Event('beforeprint'))")

    def screen(self) -> None:
        """The page on the screen again, after `paper`."""
        self.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
        self.run("window.dispatchEvent(new Event('afterprint'))")

    def picture(self, path: Path, whole: bool = False) -> Path:
        """A PNG of what the window shows, or of the whole page."""
        if whole:
            height = int(self.run("return document.documentElement.scrollHeight"))
            width = int(self.run("return innerWidth"))
            self.size(width, height)
        self.save_screenshot(str(path))
        return path

    def run(self, script: str, *arguments: Any) -> Any:
        """What a script says."""
        return self.execute_script(script, *arguments)

    def run_async(self, script: str) -> Any:
        """What a script gives to its `done(...)`."""
        return self.execute_async_script(f"const done = arguments[arguments.length - 1]; {script}")

    def find(self, selector: str) -> WebElement:
        """The element of a CSS selector."""
        return self.find_element(By.CSS_SELECTOR, selector)

    def press(self, selector: str) -> None:
        """Click on an element, in the middle of the window, once it takes clicks: a page that has
        lost its run disables its controls until it is back.
        """
        element = self.find(selector)
        self.until(f"!document.querySelector('{selector}').disabled")
        self.run("arguments[0].scrollIntoView({ block: 'center' })", element)
        element.click()

    def text(self, selector: str) -> str:
        """What an element says, as it stands in the page, whatever its style makes of it."""
        return " ".join(
            str(
                self.run("return document.querySelector(arguments[0]).textContent", selector)
            ).split()
        )

    def until(self, condition: str, patience_s: float = PATIENCE_S) -> None:
        """Wait until a condition in JavaScript holds."""
        WebDriverWait(self, patience_s, poll_frequency=0.02).until(
            lambda _: self.run(f"return {condition}"), condition
        )

    def overflowing(self) -> list[str]:
        """What reaches out of the page's window to the right, and what text is wider than its
        box.
        """
        return list(self.run(OVERFLOWING))

    def complaints(self) -> list[str]:
        """What the console has said since it was last asked, violations of the page's policy
        among it.
        """
        return [f"{entry['level']} {entry['message']}" for entry in self.get_log("browser")]


@contextmanager
def browser() -> Iterator[Browser]:
    """A browser with an empty profile."""
    profile = tempfile.mkdtemp(prefix="hilstar-chromium-")
    options = ChromeOptions()
    options.binary_location = shutil.which("chromium") or "/usr/bin/chromium"
    for flag in (*FLAGS, f"--user-data-dir={profile}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    found = Browser(
        options=options, service=Service(shutil.which("chromedriver") or "/usr/bin/chromedriver")
    )
    try:
        yield found
    finally:
        found.quit()
        shutil.rmtree(profile, ignore_errors=True)


def assert_fits_every_size_in_light_and_dark(page: Browser, directory: Path) -> None:
    """Nothing is wider than the window, and the ground above everything is the theme's; pictures
    go to the directory.
    """
    for size, theme in itertools.product(SIZES_PX, ("dark", "light")):
        page.size(*SIZES_PX[size])
        page.prefer(color_scheme=theme)
        page.until(f"document.documentElement.dataset.theme === '{theme}'")
        assert page.run("return document.documentElement.scrollWidth <= innerWidth")
        assert page.overflowing() == [], size
        shot = np.asarray(
            Image.open(page.picture(directory / f"{theme}.png")).convert("L"), dtype=float
        )
        assert shot.shape[::-1] == SIZES_PX[size]
        ground = float(np.median(shot[:5]))
        assert ground < DARK if theme == "dark" else ground > LIGHT
