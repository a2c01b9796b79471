"""All methods on the same short motions of one source."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Int

from pipeline.behavior import model as behavior
from pipeline.behavior.planning import Sampler, TorchNetworks
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import TRAIN
from pipeline.core import progress
from pipeline.geometry import rigid
from pipeline.longterm.clip_channels import Clips
from pipeline.longterm.examples import ClipSelection, MotionDataset, encode_selection, select_clips
from pipeline.longterm.journeys import LongTermWorld
from pipeline.longterm.short_motions import STEPS
from pipeline.metrics.intervals import episodes
from stages.tabulate_longterm import lengths, methods, scores, tables
from stages.tabulate_longterm import samples as behavior_samples
from stages.tabulate_longterm.config import Config
from stages.tabulate_longterm.lengths import LongMotionLength
from stages.tabulate_longterm.reading import MotionSource
from stages.tabulate_longterm.samples import SampledModel

CLIP_STRIDE = 10
"""Frames (30 fps) between the starts of held-out clips."""
RESAMPLES = 2000
"""Bootstrap resamples of the intervals: enough for their ends to stand to two digits."""
EPISODE_FRAMES = 300
"""Clips that begin within the same ten seconds count as one episode."""
BLOCKED_M = 0.06
"""A straight line from start to end that comes nearer than this to anything is not the animal's way."""


def figures(prefix: str, source: MotionSource, config: Config) -> dict[str, float | None]:
    """Measure every method on held-out short motions: on all, in unseen homes, around obstacles."""
    dataset, model = source.held_out, source.models.ours
    rng = np.random.default_rng(config.seed)
    cuts = select_pairs(select_clips(dataset, rng, stride=CLIP_STRIDE, resting=0.0), config.clips)
    if not len(cuts.start):
        return {}
    clips = encode_selection(dataset, cuts, model.poses, model.sizes.points, rng)
    known = scores.references(cuts.parts(dataset), clips.scene, dataset, model)
    plain, made = {"truth": scores.scored([each.truth for each in known], known, model)}, {}
    for name, method in methods.methods(source.models, dataset, config.seed).items():
        made[name] = method(clips)
        plain[name] = scores.scores(made[name], clips, known, model, None)
        progress.log(
            f"{prefix}: {name}, MPJPE {plain[name][:, scores.METRICS.index('mpjpe_mm')].mean():.1f} mm"
        )
    plain |= {
        f"{name}_beyond_{than}": plain[name] - plain[than]
        for name, than in methods.COMPARED_WITH.items()
        if {name, than} <= set(plain)
    }
    some = even_pairs(len(clips), config.optimized_clips)
    done = {}
    for name in methods.OPTIMIZED if source.data is None else ("ours",):
        done[f"{name}_opt"] = scores.scores(
            made[name][some], clips[some], [known[index] for index in some], model, config.optimization
        )
        done[f"{name}_same"] = plain[name][some]
        progress.log(f"{prefix}: {name}, optimised")
    episode = episodes(cuts.start, cuts.stretch, EPISODE_FRAMES)
    unseen = np.array([source.split[stretch] == "unseen" for stretch in cuts.stretch])
    found = {}
    for ending, kept in (
        ("", np.ones(len(clips), bool)),
        ("_unseen", unseen),
        ("_blocked", blocked(clips, dataset)),
    ):
        if kept.any():
            rows = {name: values[kept] for name, values in plain.items()}
            found |= tables.figures(rows, episode[kept], prefix + ending, draws=RESAMPLES, seed=config.seed)
    return found | tables.figures(done, episode[some], prefix, draws=RESAMPLES, seed=config.seed)


def select_pairs(cuts: ClipSelection, most: int) -> ClipSelection:
    """Take short motions two by two that follow each other, evenly until there are enough."""
    known = set(zip(cuts.stretch.tolist(), cuts.start.tolist(), strict=True))
    first = np.array(
        [(stretch, start) in known for stretch, start in zip(cuts.stretch, cuts.start + STEPS, strict=True)],
        bool,
    )
    stretch, start = (np.repeat(each[first], 2) for each in (cuts.stretch, cuts.start))
    start[1::2] += STEPS
    some = even_pairs(len(start), most)
    return ClipSelection(stretch[some], start[some])


def even_pairs(count: int, most: int) -> Int[np.ndarray, "some"]:
    """Return the numbers of at most ``most`` of ``count`` things that come two by two, evenly chosen."""
    first = 2 * np.unique(np.linspace(0, max(count // 2 - 1, 0), min(most, count) // 2).astype(int))
    return np.stack([first, first + 1], axis=1).reshape(-1)


def blocked(clips: Clips, dataset: MotionDataset) -> Bool[np.ndarray, "clip"]:
    """Return on which clips the straight line of the root comes nearer than `BLOCKED_M` to anything."""
    share = torch.linspace(0.1, 0.9, 17)[None, :, None]
    line = torch.lerp(clips.channels[:, :1, :3], clips.channels[:, -1:, :3], share).double().numpy()
    near = [
        dataset.scenes[scene].distance.at(torch.from_numpy(points))
        for scene, points in zip(clips.scene, rigid.apply(clips.world_from_clip, line), strict=True)
    ]
    return np.array([float(each.min()) < BLOCKED_M for each in near], bool)


def minutes(source: MotionSource, length: LongMotionLength, config: Config) -> dict[str, float | None]:
    """Make minutes of motion in the reconstructed scene."""
    been = np.concatenate([stretch.world_from_agent[::3, :3, 3] for stretch in source.train.stretches])
    return lengths.figures(world_of(source), been, length, config.optimization, config.seed)


def samples(
    source: MotionSource, model: Path, behavior_data: Path, config: Config, device: str
) -> dict[str, float | None]:
    """Make samples of the behaviour model physical, on windows of the test recording if there is one."""
    data = source.data
    assert data is not None, "only recorded motion has samples of the behaviour model"
    architecture, nets, scaling, schedule, _ = behavior.load(model)
    scenes = Scenes.load(behavior_data, data.videos)
    windows = np.flatnonzero(data.split != TRAIN)
    windows = windows if len(windows) else np.flatnonzero(data.split == TRAIN)
    some = windows[np.unique(np.linspace(0, len(windows) - 1, min(config.samples, len(windows))).astype(int))]
    sampler = Sampler(TorchNetworks(nets, device), schedule, scaling)
    asked = SampledModel(world_of(source), sampler, data, scenes, architecture.ego, some)
    return behavior_samples.figures(asked, config.optimization, draws=RESAMPLES, seed=config.seed)


def world_of(source: MotionSource) -> LongTermWorld:
    """Return the reconstructed body in its scene."""
    return LongTermWorld(source.models.ours, source.train.body, source.train.scenes[0])
