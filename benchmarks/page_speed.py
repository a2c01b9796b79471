"""Measure a page: seconds to the first visible animal and to the first plan, frame rate, size.

    python -m benchmarks.page_speed build/cat

Opens the page of a build from disk in headless Chromium, with software rendering on a given number of cores. The
first animal is the first frame that shows it; times are relative to the start of the navigation. Reports medians over
several loads, each in a new browser. Needs Chromium, and a finished `simulator`.
"""

import argparse
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from playwright.sync_api import Page

from tests.stages.export_simulator import browser

TARGETS = {"first animal, s": 5.0, "frames per second": 15.0, "page, MB": 25.0}
"""Targets on two cores: maximum, minimum, maximum."""


@dataclass(frozen=True)
class PageLoad:
    """Measurements of one page load."""

    animal_s: float
    plan_s: float
    frames_per_s: float
    pixel_ratio: float
    """rendered pixels per pixel of the window, after adaptation"""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("build", type=Path, help="folder with `simulator`, for example build/cat")
    parser.add_argument("--cores", type=int, default=2, help="cores that the browser may use")
    parser.add_argument("--size", type=int, nargs=2, default=(1920, 1080), help="window size, pixels")
    parser.add_argument("--seconds", type=float, default=10.0, help="duration of frame counting")
    parser.add_argument("--openings", type=int, default=3, help="page loads, of which the median is reported")
    arguments = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: arguments.cores])
    page = arguments.build / "simulator/index.html"
    loads = [load_page(page, tuple(arguments.size), arguments.seconds) for _ in range(arguments.openings)]
    medians = {
        name: float(np.median([getattr(each, name) for each in loads]))
        for name in PageLoad.__dataclass_fields__
    }
    assets = sum(file.stat().st_size for file in page.parent.glob("assets/*"))
    rows = {
        "first animal, s": medians["animal_s"],
        "first plan, s": medians["plan_s"],
        "frames per second": medians["frames_per_s"],
        "drawn pixels per pixel": medians["pixel_ratio"],
        "page, MB": (page.stat().st_size + assets) / 1e6,
    }
    print(
        f"{arguments.size[0]} x {arguments.size[1]}, mesh, {arguments.cores} cores, load {os.getloadavg()[0]:.1f}\n"
    )
    print("| | measured | target |\n|---|---|---|")
    for name, value in rows.items():
        print(f"| {name} | {value:.2f} | {TARGETS.get(name, '')} |")


def load_page(file: Path, size: tuple[int, int], seconds: float) -> PageLoad:
    """Load a page in a new browser and count its frames once it plans."""
    with browser.opened(file, query="?mesh", size=size, timeout_s=300) as (page, errors):
        page.wait_for_timeout(3000)  # the resolution adapts to the machine
        frames, elapsed = count_frames(page, seconds)
        state = page.evaluate("ats.state()")
        assert errors == [], errors
        marks = state["marks_s"]
        return PageLoad(marks["animal"], marks["plan"], frames / elapsed, state["pixelRatio"])


def count_frames(page: Page, seconds: float) -> tuple[int, float]:
    """Return the number of frames that a page renders, and the elapsed seconds of its clock."""
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
