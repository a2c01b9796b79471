"""Does a step of the reconstruction cost the same however many videos there are, and what does a frame cost
in memory?

    python -m benchmarks.reconstruction_scale cat --sessions 1 2 4

The first sessions of a finished build are taken, with walk-through and turnaround; each number of them in a
process of its own. Milliseconds are CPU time of one thread per step, forward, backward and update, the median
of ``--steps``. What is measured (rays and thumbnails) lies in mapped files; ``memory`` is what cannot be
dropped (anonymous pages), less what the programs took before they read a frame, when the steps are done: per
frame, poses, bones and their optimiser's state.
"""

import argparse
import dataclasses
import json
import multiprocessing
import time
from pathlib import Path

import numpy as np
import torch

from stages.reconstruct import assemble, fuse, optimise, reading
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


def opened(build: Path, sessions: int) -> Problem:
    """Return the problem of the first so many sessions."""
    videos = json.loads((build / "plan" / "videos.json").read_text())
    of_role = {
        role: [video["id"] for video in videos if video["role"] == role]
        for role in ("walkthrough", "turnaround", "session")
    }
    walkthrough, turnaround = of_role["walkthrough"][0], of_role["turnaround"][0]
    ids = [walkthrough, turnaround, *of_role["session"][:sessions]]
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
    """Return the process's memory that no file stands behind."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("RssAnon:")[1].split()[0]) / 1024


def step_ms(problem: Problem, loss, groups: list[dict], steps: int) -> float:
    """Return the median CPU milliseconds of a step."""
    optimizer, taken = torch.optim.AdamW(groups, lr=1.0), []
    for step in range(steps):
        begin = time.process_time()
        optimizer.zero_grad(set_to_none=True)
        sum(loss(step, torch.Generator().manual_seed(step)).values()).backward()
        optimizer.step()
        taken.append(1000 * (time.process_time() - begin))
    return float(np.median(taken))


def measure(build: Path, sessions: int, steps: int) -> dict[str, float]:
    """Return what one number of sessions costs."""
    torch.set_num_threads(1)
    before_mb = anonymous_mb()
    problem = opened(build, sessions)
    weights, batches, rates = LossWeights(), RayBatches(), LearningRates()
    scene = optimise.field_groups(problem.scene, rates)
    return {
        "sessions": sessions,
        "frames": len(problem.video),
        "scene_step_ms": step_ms(problem, SceneLoss(problem, weights, batches, steps), scene, steps),
        "joint_step_ms": step_ms(
            problem, JointLoss(problem, weights, batches, steps), optimise.joint_groups(problem, rates), steps
        ),
        "on_disk_kb_per_frame": stored_bytes(problem) / 1000 / len(problem.video),
        "memory_mb": anonymous_mb() - before_mb,
    }


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("agent")
    parser.add_argument("--sessions", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--steps", type=int, default=20)
    given = parser.parse_args()
    for sessions in given.sessions:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            row = pool.apply(measure, (Path("build", given.agent), sessions, given.steps))
        print("  ".join(f"{name} {value:.4g}" for name, value in row.items()), flush=True)


if __name__ == "__main__":
    main()
