"""Does the page's animal react to people as Python's does? The same approaches and the same noise for both
samplers.

    python -m benchmarks.page_reaction build/cat

Somebody walks straight at the animal in recorded moments of the build; a plan reacts where its goal shifts
more than 0.1 m away from the observer, against one 9 m away. Opens the build's page in headless Chromium and
samples one goal per plan there and in Python. Needs Chromium, and a finished `simulator`, `behavior` and
`behavior_data`.
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from pipeline.behavior.trajectories import BehaviorData
from tests.stages.export_simulator import browser, twins


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "build",
        type=Path,
        help="where `simulator`, `behavior` and `behavior_data` lie, for example build/cat",
    )
    parser.add_argument("--plans", type=int, default=200, help="how many approaches")
    parser.add_argument(
        "--checks", type=int, default=20, help="of these, how many also for a far and an ignored observer"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the approaches and of the noise")
    given = parser.parse_args()
    torch.set_num_threads(1)
    met = twins.approaches(
        BehaviorData.load(given.build / "behavior_data"), given.plans, np.random.default_rng(given.seed)
    )
    with browser.opened(given.build / "simulator/index.html", timeout_s=300) as (page, wrong):
        page.set_default_timeout(0)
        page.evaluate("ats.pause()")
        here = twins.asked_of_the_page(page, met, given.checks)
    there = twins.asked_of_python(given.build, given.build / "simulator", met, given.checks)
    print("| | page | Python |\n|---|---|---|")
    rows = {
        "plans that shift away": lambda answers: f"{100 * answers.rate(met.side):.1f} %",
        "mean shift away, m": lambda answers: f"{answers.away_m(met.side).mean():.3f}",
        "largest shift by a far observer, mm": lambda a: (
            f"{1000 * np.abs(a.opposite - a.far[: given.checks]).max():.3f}"
        ),
        "largest shift with interactivity 0, mm": lambda a: (
            f"{1000 * np.abs(a.ignored - a.far[: given.checks]).max():.3f}"
        ),
    }
    for name, told in rows.items():
        print(f"| {name} | {told(here)} | {told(there)} |")
    apart = np.linalg.norm(here.near - there.near, axis=-1)
    print(
        f"\n{given.plans} plans; the same plan in both: {1000 * np.median(apart):.3f} mm apart (median), {1000 * apart.max():.2f} mm (largest)"
    )
    if wrong:
        print("the page complained:", *wrong, sep="\n  ")


if __name__ == "__main__":
    main()
