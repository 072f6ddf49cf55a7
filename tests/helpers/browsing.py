"""A Chromium that tests drive, without a network: what it shows at a width, in the light or in the dark."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from selenium import webdriver
from selenium.common.exceptions import TimeoutException
from selenium.webdriver.chrome.service import Service

FORMULA = "=decorrelated"
"""Label of a strategy in a report, which a spreadsheet would take for a formula."""

REQUIRED = "VIBENCH_NEEDS_BROWSER"
"""Where this is set, a missing browser is a failure."""


PATIENCE = 120.0
"""Seconds until what a test waits for is missing: it comes at once, but for a machine that does other work, too."""

LOADING, ATTEMPTS = 30.0, 4
"""Seconds after which a page is opened again: beside other work Chromium may never say that one is loaded."""

OPTIONS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars",
    "--host-resolver-rules=MAP * ~NOTFOUND", "--force-color-profile=srgb",
)  # fmt: skip


def program(package: str, *names: str) -> str:
    """A program on this machine, by any of its names; the test is skipped, or fails where one is required, without."""
    found = next(filter(None, map(shutil.which, names)), None)
    if found is None:
        reason = f"{names[0]} is not installed, which Debian's package '{package}' provides"
        if os.environ.get(REQUIRED):
            pytest.fail(reason)
        pytest.skip(reason)
    return found


@contextmanager
def chromium(downloads: Path) -> Iterator[webdriver.Chrome]:
    """A browser that saves what it downloads in a folder; skips, or fails, where there is none."""
    found, driver = (
        program("chromium", "chromium", "chromium-browser", "google-chrome"),
        program("chromium-driver", "chromedriver"),
    )
    options = webdriver.ChromeOptions()
    options.binary_location = found
    for option in OPTIONS:
        options.add_argument(option)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options=options, service=Service(driver))
    browser.set_script_timeout(PATIENCE)
    browser.set_page_load_timeout(LOADING)
    try:
        saving = {"behavior": "allow", "downloadPath": str(downloads)}
        browser.execute_cdp_cmd("Browser.setDownloadBehavior", saving)
        yield browser
    finally:
        browser.quit()


def look(browser: webdriver.Chrome, page: Path, *, width: int = 1280, theme: str = "light", fragment: str = "") -> None:
    resize(browser, width)
    prefer(browser, theme)
    browser.get("about:blank")  # a change of the fragment alone would not load the page again
    load(browser, page.as_uri() + fragment)


def resize(browser: webdriver.Chrome, width: int) -> None:
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)


def prefer(browser: webdriver.Chrome, theme: str) -> None:
    """Change the colour scheme that the user prefers, "light" or "dark"."""
    features = [{"name": "prefers-color-scheme", "value": theme}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})


def load(browser: webdriver.Chrome, address: str) -> None:
    """Open an address, again if that takes too long; a `TimeoutException` if it always does."""
    for _ in range(ATTEMPTS - 1):
        with suppress(TimeoutException):
            browser.get(address)
            return
    browser.get(address)


def complaints(browser: webdriver.Chrome) -> list[Any]:
    return [entry["message"] for entry in browser.get_log("browser") if entry["level"] in {"SEVERE", "WARNING"}]


def observed(
    browser: webdriver.Chrome, page: Path, script: str, *, width: int = 1280, fragment: str = ""
) -> dict[str, Any]:
    """What a script returns on a page once it is loaded; neither of them may have errors, or say anything."""
    look(browser, page, width=width, fragment=fragment)
    found = dict(browser.execute_script(script))
    assert complaints(browser) == []
    return found
