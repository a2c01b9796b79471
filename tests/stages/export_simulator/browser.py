"""Open a page in headless Chromium with software WebGL and watch it: console, errors, requests."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Page, sync_playwright
from playwright.sync_api import TimeoutError as PlaywrightTimeout

CHROMIUM = "/usr/bin/chromium"
READY = "window.ats && ats.state().milliseconds || document.querySelector('.sorry')"
FLAGS = [
    "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-default-apps",
    "--no-first-run", "--no-default-browser-check", "--disable-domain-reliability", "--metrics-recording-only",
    "--disable-features=OptimizationHints,MediaRouter,Translate", "--no-pings", "--mute-audio",
]  # fmt: skip


@contextmanager
def opened(file: Path, query: str = "", size: tuple[int, int] = (480, 320), timeout_s: float = 60) -> Iterator[tuple[Page, list[str]]]:
    """Yield the page, once it is ready, and a growing list of everything it did wrong."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        wrong: list[str] = []
        page.on("console", lambda message: wrong.append(message.text) if message.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on(
            "request",
            lambda request: wrong.append(request.url[:200]) if request.url.split(":")[0] not in ("file", "data", "blob") else None,
        )
        page.goto(file.resolve().as_uri() + query)
        try:
            page.wait_for_function(READY, timeout=timeout_s * 1000)
            yield page, wrong
        except PlaywrightTimeout as error:
            raise AssertionError(f"{page.inner_text('body')}; {wrong}") from error
        finally:
            browser.close()
