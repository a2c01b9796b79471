"""All methods on the same short motions of one source; minutes of motion and samples of the behaviour model."""

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.models import behavior
from pipeline.models.journeys import World
from pipeline.models.longterm_examples import Cuts, Cutting, cut, encoded
from pipeline.models.planning import Sampler, TorchNetworks
from pipeline.models.scenes import Scenes
from pipeline.models.trajectories import TRAIN
from stages.tabulate_longterm import lengths, methods, scores, tables
from stages.tabulate_longterm import samples as behavior_samples
from stages.tabulate_longterm.lengths import Length
from stages.tabulate_longterm.reading import Source

EPISODE_FRAMES = 300
"""Clips that begin within the same ten seconds count as one episode."""


def figures(prefix: str, source: Source, c: Any, *, only: str | None = None) -> dict[str, float | None]:
    """Measure every method on held-out short motions, or on those of one split; nothing where there are none."""
    lives, model = source.held_out, source.models.ours
    rng = np.random.default_rng(c.seed)
    cuts = cut(lives, Cutting(stride=10, resting=0.0), rng)
    wanted = np.array([index for index, stretch in enumerate(cuts.stretch) if only in (None, source.split[stretch])], int)
    if not len(wanted):
        return {}
    wanted = wanted[np.unique(np.linspace(0, len(wanted) - 1, min(c.clips, len(wanted))).astype(int))]
    cuts = Cuts(cuts.stretch[wanted], cuts.start[wanted])
    clips = encoded(lives, cuts, model.poses, model.sizes.points, rng)
    known = scores.references(cuts.parts(lives), clips.scene, lives, model)
    episode = np.unique(np.stack([cuts.stretch, cuts.start // EPISODE_FRAMES], axis=1), axis=0, return_inverse=True)[1].ravel()
    rows = {"truth": np.array([scores.score(each.truth, each, model.poses) for each in known])}
    some = np.unique(np.linspace(0, len(clips) - 1, min(c.optimised_clips, len(clips))).astype(int))
    found = tables.figures(rows, episode, prefix, draws=c.draws, seed=c.seed)
    for name, method in methods.methods(source.models, lives, c.seed).items():
        made = method(clips)
        rows[name] = plain = scores.scores(made, clips, known, model, None)
        found |= tables.figures({name: plain}, episode, prefix, draws=c.draws, seed=c.seed)
        if name in methods.OPTIMISED and only is None:
            done = scores.scores(made[some], clips[some], [known[index] for index in some], model, c.optimisation)
            found |= tables.figures({f"{name}_opt": done, f"{name}_same": plain[some]}, episode[some], prefix, draws=c.draws, seed=c.seed)
    more = {f"{name}_beyond_ours": rows[name] - rows["ours"] for name in methods.RIVALS}
    return found | tables.figures(more, episode, prefix, draws=c.draws, seed=c.seed)


def minutes(source: Source, length: Length, c: Any) -> dict[str, float | None]:
    """Make minutes of motion in the reconstructed scene."""
    been = np.concatenate([stretch.world_from_agent[::3, :3, 3] for stretch in source.train.stretches])
    return lengths.figures(world_of(source), been, length, c.optimisation, c.seed)


def samples(source: Source, model: Path, behavior_data: Path, c: Any, device: str) -> dict[str, float | None]:
    """Make samples of the behaviour model physical, on windows of the test recording if there is one."""
    data = source.data
    architecture, nets, scaling, schedule, _ = behavior.load(model)
    scenes = Scenes.load(behavior_data, data.videos)
    windows = np.flatnonzero(data.split != TRAIN)
    windows = windows if len(windows) else np.flatnonzero(data.split == TRAIN)
    chosen = windows[np.unique(np.linspace(0, len(windows) - 1, min(c.samples, len(windows))).astype(int))]
    sampler = Sampler(TorchNetworks(nets, device), schedule, scaling)
    return behavior_samples.figures(world_of(source), sampler, data, scenes, architecture.ego, chosen, c.optimisation, c.seed)


def world_of(source: Source) -> World:
    """Return the reconstructed body in its scene."""
    return World(source.models.ours, source.train.body, source.train.scenes[0])
