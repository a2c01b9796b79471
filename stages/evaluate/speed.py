"""How long one plan takes on one core. Times differ between runs, so that they are measured only where asked for."""

import time
from dataclasses import replace

import numpy as np

from pipeline import threads
from pipeline.models.predictors import Ats
from pipeline.models.trajectories import BehaviorData
from stages.evaluate.figures import Figures

NAMES = ("simulator/plan_50_s", "simulator/plan_few_s")
REPEATS = 3


def plan_figures(data: BehaviorData, on_cpu: Ats, seed: int, *, measure: bool) -> Figures:
    """Time a whole plan (goal, path, body; K = 1) with 50 steps a level and with the default few, on one core.

    ``on_cpu``: our model, its networks on the CPU wherever all else is computed.
    """
    figures = Figures()
    if not measure or len(data.start) == 0:
        figures.skip(NAMES, "not measured: seconds would differ from run to run")
        return figures
    context, _ = data.windows(np.array([0]))
    full = replace(on_cpu, sampling=replace(on_cpu.sampling, goal_steps=50, sequence_steps=50))
    few = replace(on_cpu, sampling=replace(on_cpu.sampling, goal_steps=10, sequence_steps=10))
    for name, method in zip(NAMES, (full, few), strict=True):
        seconds = []
        with threads.alone():
            for _ in range(REPEATS):
                begin = time.perf_counter()
                method.sample(context, 1, np.random.default_rng(seed))
                seconds.append(time.perf_counter() - begin)
        figures.put(name, min(seconds))
    return figures
