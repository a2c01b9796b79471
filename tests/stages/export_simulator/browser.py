"""Pages in headless Chromium with software WebGL; console messages, errors and requests are recorded."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Page, sync_playwright
from playwright.sync_api import TimeoutError as PlaywrightTimeout

CHROMIUM = "/usr/bin/chromium"
READY = "window.ats && ats.state().milliseconds || document.querySelector('.sorry')"
FLAGS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-default-apps",
    "--no-first-run",
    "--no-default-browser-check",
    "--disable-domain-reliability",
    "--metrics-recording-only",
    "--disable-features=OptimizationHints,MediaRouter,Translate",
    "--no-pings",
    "--mute-audio",
]

FEWER_FRAMES = """
  const nextFrame = window.requestAnimationFrame.bind(window);
  window.requestAnimationFrame = (draw) => setTimeout(() => nextFrame(draw), 60);
"""
"""At most 15 frames per second: drawing more of them in software takes half of the CPU time of these tests."""


@contextmanager
def chromium() -> Iterator[Browser]:
    """Yield a browser."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def shown(
    browser: Browser,
    address: str,
    *,
    size: tuple[int, int] = (480, 320),
    script: str = "",
    timeout_s: float = 60,
    every_frame: bool = False,
    **more: Any,
) -> Iterator[tuple[Page, list[str]]]:
    """Yield the page at an address once it is ready or has failed, and a list of its errors. `script` runs
    before the page, which draws fewer frames than it could without `every_frame`; `more` are options of the
    browser context.
    """
    home = address.rsplit("/", 1)[0]
    context = browser.new_context(viewport={"width": size[0], "height": size[1]}, **more)
    page = context.new_page()
    page.add_init_script(script if every_frame else FEWER_FRAMES + script)
    wrong: list[str] = []
    page.on(
        "console",
        lambda message: wrong.append(message.text) if message.type in ("error", "warning") else None,
    )
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on(
        "request",
        lambda request: (
            None if request.url.startswith((home, "data:", "blob:")) else wrong.append(request.url[:200])
        ),
    )
    try:
        page.goto(address)
        page.wait_for_function(READY, timeout=timeout_s * 1000)
        yield page, wrong
    except PlaywrightTimeout as error:
        raise AssertionError(f"{page.inner_text('body')}; {wrong}; {error}") from error
    finally:
        context.close()


@contextmanager
def opened(
    file: Path,
    query: str = "",
    size: tuple[int, int] = (480, 320),
    timeout_s: float = 60,
    every_frame: bool = False,
) -> Iterator[tuple[Page, list[str]]]:
    """Yield a page from disk in a new browser."""
    with (
        chromium() as browser,
        shown(
            browser, file.resolve().as_uri() + query, size=size, timeout_s=timeout_s, every_frame=every_frame
        ) as page_and_wrong,
    ):
        yield page_and_wrong


def states(page: Page, ticks: int) -> Iterator[dict[str, Any]]:
    """Yield the page's state once per tick, however busy the machine is, for a number of ticks."""
    state = page.evaluate("ats.state()")
    end = state["tick"] + ticks
    while state["tick"] < end:
        yield state
        page.wait_for_function("tick => ats.state().tick > tick", arg=state["tick"])
        state = page.evaluate("ats.state()")
