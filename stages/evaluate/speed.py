"""Seconds per plan on one core; they differ between runs, so that they are measured only if asked for."""

import time
from dataclasses import replace

import numpy as np

from pipeline.baselines.predictors import Ats
from pipeline.behavior.trajectories import BehaviorData
from pipeline.core import threads
from pipeline.metrics.metrics import Metrics

STEPS = {"simulator/plan_50_s": 50, "simulator/plan_few_s": 10}
"""By metric: steps a level of the plans that are timed."""
REPEATS = 3


def plan_metrics(data: BehaviorData, on_cpu: Ats, seed: int, *, measure: bool) -> Metrics:
    """Time a whole plan (goal, path, body; K = 1) with 50 steps a level and with the default few, on one
    core.

    ``on_cpu``: our model, its networks on the CPU wherever all else is computed.
    """
    metrics = Metrics()
    if not measure or len(data.start) == 0:
        metrics.skip(STEPS, "not measured: seconds would differ from run to run")
        return metrics
    context, _ = data.windows(np.array([0]))
    for name, steps in STEPS.items():
        sampling = replace(on_cpu.sampling, goal_steps=steps, sequence_steps=steps)
        method, seconds = replace(on_cpu, sampling=sampling), []
        with threads.single_threaded():
            for _ in range(REPEATS):
                begin = time.perf_counter()
                method.sample(context, 1, np.random.default_rng(seed))
                seconds.append(time.perf_counter() - begin)
        metrics.put(name, min(seconds))
    return metrics
