"""Compare the reaction to approaching people of the exported page with that of the Python sampler, with the same
approaches and noise.

    python -m benchmarks.page_reaction build/cat

An observer walks straight towards the animal, starting from recorded moments of the build. A plan reacts if its goal
shifts by more than 0.1 m away from the observer, compared with an observer at 9 m. Opens the page in headless
Chromium and samples one goal per plan there and in Python. Needs Chromium, and a finished `simulator`, `behavior` and
`behavior_data`.
"""

from pathlib import Path

import numpy as np
import torch

from benchmarks import command_lines
from pipeline.behavior.trajectories import BehaviorData
from tests.stages.export_simulator import browser, twins


def main() -> None:
    """Print the table."""
    parser = command_lines.described(__doc__)
    parser.add_argument(
        "build",
        type=Path,
        help="folder with `simulator`, `behavior` and `behavior_data`, for example build/cat",
    )
    parser.add_argument("--plans", type=int, default=200, help="number of approaches")
    parser.add_argument(
        "--checks",
        type=int,
        default=20,
        help="number of these that are also sampled with a distant and with an ignored observer",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of approaches and noise")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    approaches = twins.approaches(
        BehaviorData.load(arguments.build / "behavior_data"),
        arguments.plans,
        np.random.default_rng(arguments.seed),
    )
    with browser.opened(arguments.build / "simulator/index.html", timeout_s=300) as (page, errors):
        page.set_default_timeout(0)
        page.evaluate("ats.pause()")
        of_page = twins.goals_of_page(page, approaches, arguments.checks)
    of_python = twins.goals_of_python(
        arguments.build, arguments.build / "simulator", approaches, arguments.checks
    )
    print("| | page | Python |\n|---|---|---|")
    rows = {
        "plans that shift away": lambda answers: f"{100 * answers.rate(approaches.side):.1f} %",
        "mean shift away, m": lambda answers: f"{answers.away_m(approaches.side).mean():.3f}",
        "largest shift by a distant observer, mm": lambda a: (
            f"{1000 * np.abs(a.opposite - a.far[: arguments.checks]).max():.3f}"
        ),
        "largest shift with interactivity 0, mm": lambda a: (
            f"{1000 * np.abs(a.ignored - a.far[: arguments.checks]).max():.3f}"
        ),
    }
    for name, cell in rows.items():
        print(f"| {name} | {cell(of_page)} | {cell(of_python)} |")
    distance = np.linalg.norm(of_page.near - of_python.near, axis=-1)
    print(
        f"\n{arguments.plans} plans; distance between page and Python: {1000 * np.median(distance):.3f} mm (median), {1000 * distance.max():.2f} mm (maximum)"
    )
    if errors:
        print("errors of the page:", *errors, sep="\n  ")


if __name__ == "__main__":
    main()
