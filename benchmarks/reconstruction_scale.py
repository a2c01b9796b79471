"""Measure the time of a reconstruction step and the memory per frame for different numbers of videos.

    python -m benchmarks.reconstruction_scale cat --sessions 1 2 4

Uses the first sessions of a finished build with walk-through and turnaround; each number of sessions runs in its own
process. Milliseconds are the median single-thread CPU time per step (forward, backward, update) over ``--steps``. Rays
and thumbnails are memory-mapped; ``memory_mb`` is the growth of anonymous memory from before the first frame is read
until the steps are done: poses, bones and their optimizer state per frame.
"""

import dataclasses
import time
from pathlib import Path

import numpy as np
import torch

from benchmarks import command_lines
from benchmarks.command_lines import recordings
from stages.reconstruct import assemble, fuse, optimize, reading
from stages.reconstruct.config import (
    FieldSizes,
    LearningRates,
    LossWeights,
    PixelSampling,
    RayBatches,
    SceneFusion,
)
from stages.reconstruct.joint import JointLoss
from stages.reconstruct.problem import Problem
from stages.reconstruct.scene import SceneLoss

KINDS = ("frames", "masks", "flow", "features")


def load_problem(build: Path, sessions: int) -> Problem:
    """Return the optimization problem of the first ``sessions`` sessions."""
    walkthrough, turnaround = (recordings(build, role)[0] for role in ("walkthrough", "turnaround"))
    ids = [walkthrough, turnaround, *recordings(build, "session")[:sessions]]
    found = {kind: {id: build / kind / id for id in ids if (build / kind / id).exists()} for kind in KINDS}
    folders = reading.Inputs(
        **found, **{name: build / name for name in ("registration", "scene_template", "agent_template")}
    )
    read = reading.read_videos(folders, walkthrough, turnaround, PixelSampling(), 0)
    fused = fuse.fuse_depth(read, SceneFusion())
    return assemble.build(read, reading.read_template(folders.agent_template), FieldSizes(), 0, "cpu", fused)


def stored_bytes(problem: Problem) -> int:
    """Return the size of all rays and thumbnails."""
    tables = (problem.store.scene, problem.store.agent, problem.store.views)
    tensors = [getattr(table, field.name) for table in tables for field in dataclasses.fields(table)]
    return sum(tensor.nbytes for tensor in tensors)


def anonymous_mb() -> float:
    """Return the anonymous memory of the process."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("RssAnon:")[1].split()[0]) / 1024


def step_ms(problem: Problem, loss, groups: list[dict], steps: int) -> float:
    """Return the median CPU milliseconds of a step."""
    optimizer, times_ms = torch.optim.AdamW(groups, lr=1.0), []
    for step in range(steps):
        start = time.process_time()
        optimizer.zero_grad(set_to_none=True)
        sum(loss(step, torch.Generator().manual_seed(step)).values()).backward()
        optimizer.step()
        times_ms.append(1000 * (time.process_time() - start))
    return float(np.median(times_ms))


def measure(build: Path, sessions: int, steps: int) -> dict[str, float]:
    """Return the cost for one number of sessions."""
    torch.set_num_threads(1)
    before_mb = anonymous_mb()
    problem = load_problem(build, sessions)
    weights, batches, rates = LossWeights(), RayBatches(), LearningRates()
    scene = optimize.field_groups(problem.scene, rates)
    return {
        "sessions": sessions,
        "frames": len(problem.video),
        "scene_step_ms": step_ms(problem, SceneLoss(problem, weights, batches, steps), scene, steps),
        "joint_step_ms": step_ms(
            problem, JointLoss(problem, weights, batches, steps), optimize.joint_groups(problem, rates), steps
        ),
        "on_disk_kb_per_frame": stored_bytes(problem) / 1000 / len(problem.video),
        "memory_mb": anonymous_mb() - before_mb,
    }


def main() -> None:
    """Measure and print the table."""
    parser = command_lines.described(__doc__)
    parser.add_argument("agent")
    parser.add_argument("--sessions", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--steps", type=int, default=20)
    arguments = parser.parse_args()
    for sessions in arguments.sessions:
        row = command_lines.in_own_process(measure, Path("build", arguments.agent), sessions, arguments.steps)
        print("  ".join(f"{name} {value:.4g}" for name, value in row.items()), flush=True)


if __name__ == "__main__":
    main()
