"""Measure a page: seconds to the first visible animal and to the first plan, frame rate, size.

    python -m benchmarks.page_speed build/cat build/pair

Opens the pages of builds (of one animal, or of a home of several) from disk in headless Chromium, with software rendering on a given number of cores. The
first animal is the first frame that shows it; times are relative to the start of the navigation. CPU time per frame
can be compared on a busy machine too. Reports medians over several loads, each in a new browser. Needs Chromium, and a finished `simulator` or `home_simulator`.
"""

import contextlib
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from playwright.sync_api import Page

from benchmarks import command_lines
from tests.stages.export_simulator import browser

TARGETS = {
    "first animal, s": "at most 5",
    "frames per second": "at least 15",
    "page, MB": "at most 25, 30 of two animals",
}
"""Targets on two cores."""
PAGES = "simulator/index.html", "home_simulator/index.html"


@dataclass(frozen=True)
class PageLoad:
    """Measurements of one page load."""

    animal_s: float
    plan_s: float
    frames_per_s: float
    pixel_ratio: float
    """rendered pixels per pixel of the window, after adaptation"""
    cpu_ms: float
    """CPU milliseconds of all processes of the browser per frame, plans included"""


def main() -> None:
    """Print the table."""
    parser = command_lines.described(__doc__)
    parser.add_argument(
        "build",
        type=Path,
        nargs="+",
        help="folders with `simulator` or `home_simulator`: build/cat build/pair",
    )
    parser.add_argument("--cores", type=int, default=2, help="cores that the browser may use")
    parser.add_argument("--size", type=int, nargs=2, default=(1920, 1080), help="window size, pixels")
    parser.add_argument("--seconds", type=float, default=10.0, help="duration of frame counting")
    parser.add_argument("--openings", type=int, default=3, help="page loads, of which the median is reported")
    arguments = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: arguments.cores])
    measured = [
        measure(page_of(build), tuple(arguments.size), arguments.seconds, arguments.openings)
        for build in arguments.build
    ]
    print(
        f"{arguments.size[0]} x {arguments.size[1]}, mesh, {arguments.cores} cores, load {os.getloadavg()[0]:.1f}\n"
    )
    names = [build.resolve().name for build in arguments.build]
    print(f"| | {' | '.join(names)} | target |\n|---|{'---|' * len(names)}---|")
    for name in measured[0]:
        values = " | ".join(f"{each[name]:.2f}" for each in measured)
        print(f"| {name} | {values} | {TARGETS.get(name, '')} |")


def page_of(build: Path) -> Path:
    """Return the page of a build: of its animal, or of its home of several animals."""
    found = [build / name for name in PAGES if (build / name).is_file()]
    if not found:
        raise SystemExit(f"{build}: has none of {', '.join(PAGES)}; make it: make {build.name}")
    return found[0]


def measure(page: Path, size: tuple[int, int], seconds: float, openings: int) -> dict[str, float]:
    """Return the rows of the table of one page: medians over several loads, and megabytes."""
    loads = [load_page(page, size, seconds) for _ in range(openings)]
    medians = {
        name: float(np.median([getattr(each, name) for each in loads]))
        for name in PageLoad.__dataclass_fields__
    }
    assets = sum(file.stat().st_size for file in page.parent.glob("assets/*"))
    return {
        "first animal, s": medians["animal_s"],
        "first plan, s": medians["plan_s"],
        "frames per second": medians["frames_per_s"],
        "drawn pixels per pixel": medians["pixel_ratio"],
        "CPU ms per frame": medians["cpu_ms"],
        "page, MB": (page.stat().st_size + assets) / 1e6,
    }


def load_page(file: Path, size: tuple[int, int], seconds: float) -> PageLoad:
    """Load a page in a new browser and count its frames once it plans."""
    with browser.opened(file, query="?mesh", size=size, timeout_s=300, every_frame=True) as (page, errors):
        page.wait_for_timeout(3000)  # the resolution adapts to the machine
        begin_s = browser_cpu_s()
        frames, elapsed = count_frames(page, seconds)
        cpu_ms = 1000 * (browser_cpu_s() - begin_s) / frames
        state = page.evaluate("ats.state()")
        assert errors == [], errors
        marks = state["marks_s"]
        return PageLoad(marks["animal"], marks["plan"], frames / elapsed, state["pixelRatio"], cpu_ms)


def browser_cpu_s() -> float:
    """Return the CPU seconds of all processes that this one has started, and theirs; they all run (Linux)."""
    ticks, parent = {}, {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it has ended
            fields = stat.read_text().rpartition(")")[2].split()
            pid = int(stat.parent.name)
            parent[pid], ticks[pid] = int(fields[1]), int(fields[11]) + int(fields[12])
    own = {os.getpid()}
    while more := {pid for pid, by in parent.items() if by in own} - own:
        own |= more
    return sum(ticks[pid] for pid in own - {os.getpid()}) / os.sysconf("SC_CLK_TCK")


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
