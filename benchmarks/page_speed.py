"""How fast and how big is a page? Seconds to the first animal and to the first plan, frames a second, megabytes.

    python -m benchmarks.page_speed build/cat

Opens the build's page from the disk in headless Chromium, which draws in software, on as many cores as asked
for, and watches it live. The first animal is the first frame that shows it; seconds count from the beginning
of the navigation. Medians of several openings, each in a browser of its own. Needs Chromium, and a finished
`simulator`.
"""

import argparse
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from playwright.sync_api import Page

from tests.stages.export_simulator import browser

BARS = {"first animal, s": 5.0, "frames a second": 15.0, "page, MB": 25.0}
"""What a page should reach on two cores: at most, at least, at most."""


@dataclass(frozen=True)
class Opening:
    """One opening of a page."""

    animal_s: float
    plan_s: float
    frames_per_s: float
    pixel_ratio: float
    """drawn pixels per pixel of the window, after it has adapted"""


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("build", type=Path, help="where `simulator` lies, for example build/cat")
    parser.add_argument("--cores", type=int, default=2, help="cores that the browser may use")
    parser.add_argument("--size", type=int, nargs=2, default=(1920, 1080), help="of the window, pixels")
    parser.add_argument("--seconds", type=float, default=10.0, help="how long frames are counted")
    parser.add_argument("--openings", type=int, default=3, help="of which the median is shown")
    given = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: given.cores])
    page = given.build / "simulator/index.html"
    openings = [measured(page, tuple(given.size), given.seconds) for _ in range(given.openings)]
    middle = {
        name: float(np.median([getattr(each, name) for each in openings]))
        for name in Opening.__dataclass_fields__
    }
    assets = sum(file.stat().st_size for file in page.parent.glob("assets/*"))
    rows = {
        "first animal, s": middle["animal_s"],
        "first plan, s": middle["plan_s"],
        "frames a second": middle["frames_per_s"],
        "drawn pixels per pixel": middle["pixel_ratio"],
        "page, MB": (page.stat().st_size + assets) / 1e6,
    }
    print(f"{given.size[0]} x {given.size[1]}, mesh, {given.cores} cores, load {os.getloadavg()[0]:.1f}\n")
    print("| | measured | bar |\n|---|---|---|")
    for name, value in rows.items():
        print(f"| {name} | {value:.2f} | {BARS.get(name, '')} |")


def measured(file: Path, size: tuple[int, int], seconds: float) -> Opening:
    """Open a page in a browser of its own and count its frames once it plans."""
    with browser.opened(file, query="?mesh", size=size, timeout_s=300) as (page, wrong):
        page.wait_for_timeout(3000)  # the number of drawn pixels adapts to the machine
        frames, elapsed = counted(page, seconds)
        state = page.evaluate("ats.state()")
        assert wrong == [], wrong
        marks = state["marks_s"]
        return Opening(marks["animal"], marks["plan"], frames / elapsed, state["pixelRatio"])


def counted(page: Page, seconds: float) -> tuple[int, float]:
    """Return how many frames a page draws, and in how many seconds by its own clock."""
    return tuple(
        page.evaluate(
            """async (wanted) => {
              const [frames, begin] = [ats.frames(), performance.now()];
              await new Promise((done) => setTimeout(done, 1000 * wanted));
              return [ats.frames() - frames, (performance.now() - begin) / 1000];
            }""",
            seconds,
        )
    )


if __name__ == "__main__":
    main()
