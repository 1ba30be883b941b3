"""README's picture of a report, taken by Chromium: what `latentds compare` makes of what `latentds demo` writes.

python -m experiments.screenshot [--out docs/images/report.png]
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from latentds import cli
from latentds.files import atomic_write

METHODS = ("TubeDS", "Chebyshev", "FDM")


def main(
    out: Annotated[Path, typer.Option(help="File to write, .png.")] = Path("docs/images/report.png"),
    width: Annotated[int, typer.Option(help="Of the window, in pixels.")] = 1400,
    height: Annotated[int, typer.Option(help="Of the window, in pixels.")] = 1430,
) -> None:
    """Compare on the made-up arm, and take a picture of the page."""
    with tempfile.TemporaryDirectory() as folder:
        recording, page = Path(folder, "arm.csv"), Path(folder, "arm.html")
        cli.demo(recording)
        cli.compare([recording], list(METHODS), report=page)
        with browser(width, height) as window:
            show(window, page)
            picture = window.get_screenshot_as_png()
    with atomic_write(out) as file:
        file.write(picture)


@contextmanager
def browser(width: int, height: int) -> Iterator[Any]:
    """A selenium driver of a window so large, without a screen; its console is kept.

    Raises:
        FileNotFoundError: if chromium or chromedriver is not installed. Nothing is ever downloaded.
    """
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    program, driver = (shutil.which(name) for name in ("chromium", "chromedriver"))
    if program is None or driver is None:
        raise FileNotFoundError("expected chromium and chromedriver: apt install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    for argument in ("headless=new", "disable-dev-shm-usage", "hide-scrollbars", "enable-unsafe-swiftshader"):
        options.add_argument(f"--{argument}")
    if os.geteuid() == 0:
        options.add_argument("--no-sandbox")  # which Chromium refuses to make for root
    window = webdriver.Chrome(options, Service(driver))
    try:
        # Chromium makes no window narrower than 500 pixels: it is told what to take it for.
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        window.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        yield window
    finally:
        window.quit()


def show(window: Any, page: Path) -> None:
    """Open a report, and wait until its pictures are on the screen."""
    from selenium.webdriver.support.wait import WebDriverWait

    window.get(page.as_uri())
    WebDriverWait(window, 60).until(lambda _: window.execute_script("return 'drawn' in document.body.dataset"))
    window.execute_async_script("requestAnimationFrame(() => requestAnimationFrame(arguments[0]))")


if __name__ == "__main__":
    typer.run(main)
