"""Evaluate on public real data and print one table.

    make real-benchmark DATA=folder
    python -m benchmarks.real folder --rows walkers --seeds 3

Rows without data are skipped, with the expected layout. Finished results are cached in the output folder: an
interrupted run resumes, and a new run needs a new folder.
"""

import argparse
import subprocess
from datetime import date
from pathlib import Path

import cv2
import torch

from benchmarks import command_lines
from benchmarks.real.rows import ROWS
from benchmarks.real.table import write
from pipeline.core.progress import log


def stamp(arguments: argparse.Namespace) -> str:
    """Return command, date and commit."""
    git = ["git", "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(git, capture_output=True, text=True, cwd=Path(__file__).parent).stdout.strip()
    command = f"python -m benchmarks.real DATA --rows {' '.join(arguments.rows)} --seeds {arguments.seeds}"
    return f"`{command}`, {date.today().isoformat()}, commit {commit or 'unknown'}."


def main() -> None:
    """Print the table and write it as Markdown and JSON."""
    parser = command_lines.described(__doc__)
    parser.add_argument("data", type=Path, help="folder with the public data")
    parser.add_argument("--out", type=Path, default=Path("build/real_benchmark"), help="output folder")
    parser.add_argument("--rows", nargs="+", default=list(ROWS), choices=list(ROWS), help="rows to measure")
    parser.add_argument("--seeds", type=int, default=1, help="number of training seeds")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    rows, skipped = [], {}
    for name in arguments.rows:
        row_kind = ROWS[name]
        location = row_kind.find(arguments.data)
        if location is None:
            skipped[name] = f"Expected {row_kind.layout} below {arguments.data}. Source: {row_kind.source}."
            log(f"{name}: skipped. {skipped[name]}")
            continue
        rows.append(row_kind.measure(location, arguments.out, arguments.seeds))
        write(arguments.out, rows, skipped, stamp(arguments))
    print(write(arguments.out, rows, skipped, stamp(arguments)))


if __name__ == "__main__":
    main()
