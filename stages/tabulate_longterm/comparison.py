"""Comparison of all methods on the same clips of one source of motion."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from pipeline.core import progress
from pipeline.geometry import rigid
from pipeline.longterm.clip_channels import Clips
from pipeline.longterm.examples import ClipSelection, MotionDataset, encode_selection, select_clips
from pipeline.longterm.short_motions import RATE_HZ, STEPS
from pipeline.metrics.intervals import episodes
from stages.tabulate_longterm import methods, scores, tables
from stages.tabulate_longterm.config import Config
from stages.tabulate_longterm.reading import MotionSource

CLIP_STRIDE = 10
"""Frames (30 fps) between the starts of held-out clips."""
EPISODE_FRAMES = 300
"""Clips that start within the same ten seconds are one episode."""
LENGTHS_S, LENGTH_RUNS = (2, 4, 6), 8
"""Lengths of the longer motions, with true bodies every two seconds (paper Sec. 4.2), and their number."""
ALONG = (0.1, 0.9, 17)
"""first and last sample along the line, and their number: a body may touch things at its ends"""
BLOCKED_M = 0.06
"""A straight line from start to end with less clearance than this is blocked."""


def figures(prefix: str, source: MotionSource, config: Config) -> dict[str, float | None]:
    """Return the metrics of every method on held-out clips: all, in unseen homes, and around obstacles."""
    dataset, model = source.split.held_out, source.ours
    if dataset is None:
        return {}
    rng = np.random.default_rng(config.seed)
    traveled = select_clips(dataset, rng, stride=CLIP_STRIDE, resting=0.0)
    cuts = select_runs(traveled, 2, config.clips)
    if not len(cuts.start):
        return {}
    clips = encode_selection(dataset, cuts, model.poses, model.sizes.points, rng)
    known = scores.references(cuts.parts(dataset), clips.scene, dataset, model)
    plain, made = {"truth": scores.score_pairs([each.truth for each in known], known, model)}, {}
    for name, method in methods.methods(source, dataset, config.seed).items():
        made[name] = scores.decode_clips(method(clips), clips, known, model)
        plain[name] = scores.score_pairs(made[name], known, model)
        mpjpe_mm = plain[name][:, scores.METRICS.index("mpjpe_mm")].mean()
        progress.log(f"{prefix}: {name}, MPJPE {mpjpe_mm:.1f} mm")
    plain |= _differences(plain)
    some = even_runs(len(clips), 2, config.optimized_clips)
    done = {}
    optimized = methods.OPTIMIZED if source.data is None else ("ours",)
    for name in optimized:
        motions, true = ([each[index] for index in some] for each in (made[name], known))
        done[f"{name}_opt"] = scores.score_pairs(motions, true, model, config.optimization)
        done[f"{name}_same"] = plain[name][some]
        progress.log(f"{prefix}: {name}, optimized")
    episode = episodes(cuts.start, cuts.stretch, EPISODE_FRAMES)
    unseen = np.array([source.split.kinds[stretch] == "unseen" for stretch in cuts.stretch])
    found, every = {}, np.ones(len(clips), bool)
    for ending, chosen in (("", every), ("_unseen", unseen), ("_blocked", blocked(clips, dataset))):
        if chosen.any():
            rows = {name: values[chosen] for name, values in plain.items()}
            found |= tables.figures(rows, episode[chosen], prefix + ending, seed=config.seed)
    found |= tables.figures(done, episode[some], prefix, seed=config.seed)
    return found | _figures_of_lengths(prefix, source, traveled, optimized, config)


def _figures_of_lengths(
    prefix: str, source: MotionSource, cuts: ClipSelection, optimized: tuple[str, ...], config: Config
) -> dict[str, float | None]:
    """Return the metrics of optimized motions of several lengths, each as a whole, from the same starts."""
    dataset, model = source.split.held_out, source.ours
    assert dataset is not None
    run = max(LENGTHS_S) * RATE_HZ // STEPS
    cuts = select_runs(cuts, run, run * LENGTH_RUNS)
    if not len(cuts.start):
        return {}
    rng = np.random.default_rng(config.seed)
    clips = encode_selection(dataset, cuts, model.poses, model.sizes.points, rng)
    known = scores.references(cuts.parts(dataset), clips.scene, dataset, model)
    every = methods.methods(source, dataset, config.seed)
    made = {name: scores.decode_clips(every[name](clips), clips, known, model) for name in optimized}
    episode, found = episodes(cuts.start, cuts.stretch, EPISODE_FRAMES)[::run], {}
    for seconds in LENGTHS_S:
        parts = seconds * RATE_HZ // STEPS
        rows = {"truth": scores.score_runs([each.truth for each in known], known, model, run, parts)}
        for name, motions in made.items():
            rows[f"{name}_opt"] = scores.score_runs(motions, known, model, run, parts, config.optimization)
        rows |= _differences(rows, "_opt")
        found |= tables.figures(rows, episode, f"{prefix}_{seconds}s", seed=config.seed)
        progress.log(f"{prefix}: {len(episode)} motions of {seconds} s, optimized")
    return found


def _differences(
    rows: dict[str, Float[np.ndarray, "clip metric"]], ending: str = ""
) -> dict[str, Float[np.ndarray, "clip metric"]]:
    """Return what the methods are beyond those that `methods.COMPARED_WITH` names, motion by motion."""
    pairs = ((f"{name}{ending}", f"{than}{ending}") for name, than in methods.COMPARED_WITH.items())
    return {
        f"{name}_beyond_{than}": rows[name] - rows[than]
        for name, than in pairs
        if {name, than} <= rows.keys()
    }


def select_runs(cuts: ClipSelection, run: int, most: int) -> ClipSelection:
    """Select evenly spread runs of ``run`` consecutive clips, at most ``most`` clips."""
    known = set(zip(cuts.stretch.tolist(), cuts.start.tolist(), strict=True))
    begins = [
        all((stretch, start + number * STEPS) in known for number in range(run))
        for stretch, start in zip(cuts.stretch.tolist(), cuts.start.tolist(), strict=True)
    ]
    stretch, start = (np.repeat(each[np.array(begins, bool)], run) for each in (cuts.stretch, cuts.start))
    start += np.arange(len(start)) % run * STEPS
    some = even_runs(len(start), run, most)
    return ClipSelection(stretch[some], start[some])


def even_runs(count: int, run: int, most: int) -> Int[np.ndarray, "some"]:
    """Return indices of at most ``most`` of ``count`` items in evenly spread whole runs of ``run``."""
    first = run * np.unique(np.linspace(0, max(count // run - 1, 0), min(most, count) // run).astype(int))
    return (first[:, None] + np.arange(run)).reshape(-1)


def blocked(clips: Clips, dataset: MotionDataset) -> Bool[np.ndarray, "clip"]:
    """Return the clips whose straight root path has less clearance than `BLOCKED_M`."""
    share = torch.linspace(*ALONG)[None, :, None]
    line = torch.lerp(clips.channels[:, :1, :3], clips.channels[:, -1:, :3], share).double().numpy()
    distances = [
        dataset.scenes[scene].distance.at(torch.from_numpy(points))
        for scene, points in zip(clips.scene, rigid.apply(clips.world_from_clip, line), strict=True)
    ]
    return np.array([float(each.min()) < BLOCKED_M for each in distances], bool)
