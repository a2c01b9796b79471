"""Seconds per plan on one core; they differ between runs, so that they are measured only if asked for."""

import time
from dataclasses import replace

import numpy as np

from pipeline.behavior.trajectories import BehaviorData
from pipeline.core import threads
from pipeline.metrics.metrics import Metrics
from pipeline.rivals.predictors import Ats

NAMES = ("simulator/plan_50_s", "simulator/plan_few_s")
REPEATS = 3
ALL_STEPS, FEW_STEPS = 50, 10


def plan_metrics(data: BehaviorData, on_cpu: Ats, seed: int, *, measure: bool) -> Metrics:
    """Time a whole plan (goal, path, body; K = 1) with 50 steps a level and with the default few, on one
    core.

    ``on_cpu``: our model, its networks on the CPU wherever all else is computed.
    """
    metrics = Metrics()
    if not measure or len(data.start) == 0:
        metrics.skip(NAMES, "not measured: seconds would differ from run to run")
        return metrics
    context, _ = data.windows(np.array([0]))
    full = replace(on_cpu, sampling=replace(on_cpu.sampling, goal_steps=ALL_STEPS, sequence_steps=ALL_STEPS))
    few = replace(on_cpu, sampling=replace(on_cpu.sampling, goal_steps=FEW_STEPS, sequence_steps=FEW_STEPS))
    for name, method in zip(NAMES, (full, few), strict=True):
        seconds = []
        with threads.alone():
            for _ in range(REPEATS):
                begin = time.perf_counter()
                method.sample(context, 1, np.random.default_rng(seed))
                seconds.append(time.perf_counter() - begin)
        metrics.put(name, min(seconds))
    return metrics
