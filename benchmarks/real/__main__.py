"""Measure figures on public real data and print one table.

    make real-benchmark DATA=folder
    python -m benchmarks.real folder --rows walkers --seeds 3

What the folder lacks is skipped with the layout that is expected. Finished figures are kept in the output folder:
a stopped run goes on, and another run needs another folder.
"""

import argparse
import subprocess
from datetime import date
from pathlib import Path

import cv2
import torch

from benchmarks.real.rows import ROWS
from benchmarks.real.table import write
from pipeline.core.progress import log


def stamp(arguments: argparse.Namespace) -> str:
    """Return command, date and commit."""
    asked = ["git", "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(asked, capture_output=True, text=True, cwd=Path(__file__).parent).stdout.strip()
    command = f"python -m benchmarks.real DATA --rows {' '.join(arguments.rows)} --seeds {arguments.seeds}"
    return f"`{command}`, {date.today().isoformat()}, commit {commit or 'unknown'}."


def main() -> None:
    """Print the table and write it as Markdown and JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path, help="folder that holds the public data")
    parser.add_argument("--out", type=Path, default=Path("build/real_benchmark"), help="where all is written")
    parser.add_argument("--rows", nargs="+", default=list(ROWS), choices=list(ROWS), help="rows measured")
    parser.add_argument("--seeds", type=int, default=1, help="trainings of each learned model")
    given = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    rows, skipped = [], {}
    for name in given.rows:
        kind = ROWS[name]
        where = kind.found(given.data)
        if where is None:
            skipped[name] = f"Expected {kind.layout} below {given.data}. Source: {kind.source}."
            log(f"{name}: skipped. {skipped[name]}")
            continue
        rows.append(kind.measure(where, given.out, given.seeds))
        write(given.out, rows, skipped, stamp(given))
    print(write(given.out, rows, skipped, stamp(given)))


if __name__ == "__main__":
    main()
