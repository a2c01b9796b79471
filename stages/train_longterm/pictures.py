"""What the quality page of long-term motion shows: losses, routes and bodies on motion that was not learned from."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from matplotlib.figure import Figure

from pipeline import figures
from pipeline.models.clip_channels import Clips
from pipeline.models.longterm import ROOT
from pipeline.models.longterm_examples import Cutting, Lives, cut, encoded
from pipeline.models.plausibility import Judge
from pipeline.qa import Check, Picture
from pipeline.space import rigid
from stages.train_longterm.learning import Learned
from stages.train_longterm.sources import Parted

SHOWN = 8
TRIED = 60


@dataclass(frozen=True)
class Shown:
    """Checks and pictures of a model."""

    checks: list[Check]
    pictures: list[Picture]


def shown(learned: Learned, lives: Parted, seed: int) -> Shown:
    """Try a model on held-out motion, or where there is none on what it learned from."""
    where = lives.held_out or lives.train
    rng = np.random.default_rng(seed)
    cuts = cut(where, Cutting(stride=15, resting=0.3, most_clips=TRIED), rng)
    clips = encoded(where, cuts, learned.model.poses, learned.model.sizes.points, rng)
    made = learned.model.between(clips.channels[:, 0], clips.channels[:, -1], clips.seen)
    line = torch.lerp(clips.channels[:, :1], clips.channels[:, -1:], torch.linspace(0, 1, made.shape[1])[None, :, None])
    error, straight = (float((each - clips.channels)[..., :3].abs().mean()) for each in (made, line))
    gap, depth = _stills(learned, where, rng)
    checks = [
        Check("L1 of held-out routes", 100 * error, "cm", 10.0),
        Check("L1 of held-out routes against straight lines", error / max(straight, 1e-9), "", 0.9),
        Check("bodies at sub-goals: gap to the scene, median", 100 * gap, "cm", 2.0),
        Check("bodies at sub-goals: deepest vertex in the scene, median", 100 * depth, "cm", 4.0),
        Check("contact vertices found", len(learned.model.contacts.vertices), "", 10, 1, "higher"),
        Check("spread of poses that p explains", float(learned.model.poses.explained), "share", 0.9, 0.5, "higher"),
    ]
    pictures = [
        Picture("losses", losses(learned), "Loss of each network over its training, smoothed."),
        Picture("routes", routes(clips, made, where), "Held-out routes from above: true (blue), made (orange), what stands nearby (grey)."),
    ]
    return Shown(checks, pictures)


def _stills(learned: Learned, where: Lives, rng: np.random.Generator) -> tuple[float, float]:
    """Return the median gap under bodies drawn at held-out places, and how deep they are in the scene."""
    stretch, scene = where.stretches[0], where.scenes[where.scene_of[0]]
    places = stretch.world_from_agent[np.linspace(0, len(stretch) - 1, 12).astype(int)]
    made = learned.model.bodies(places, where.body, scene, rng, candidates=4)
    judge = Judge(where.body, learned.model.contacts, scene.distance)
    gap, depth = judge.fit_of(made)
    return float(np.median(gap)), float(np.median(depth))


def losses(learned: Learned) -> UInt8[np.ndarray, "height width 3"]:
    """Draw every network's total loss."""
    figure = Figure(figsize=(8, 3), dpi=80, layout="constrained")
    for axis, (name, record) in zip(figure.subplots(1, 3), learned.records.items(), strict=True):
        total = record.total()
        width = max(len(total) // 40, 1)
        axis.plot(np.convolve(total, np.ones(width) / width, mode="valid"), color="#3b6ea5")
        axis.set(title=name, yscale="log", xlabel="step")
    return figures.pixels(figure)


def routes(clips: Clips, made: Float[torch.Tensor, "clip frame channel"], where: Lives) -> UInt8[np.ndarray, "height width 3"]:
    """Draw some clips from above, in their own frames."""
    figure = Figure(figsize=(10, 5.4), dpi=80, layout="constrained")
    axes = figure.subplots(2, SHOWN // 2).ravel()
    for axis, index in zip(axes, np.linspace(0, len(clips) - 1, SHOWN).astype(int), strict=True):
        points = where.scenes[clips.scene[index]].surface.points
        local = rigid.apply(rigid.inverse(clips.world_from_clip[index]), points)
        near = (np.abs(local[:, [0, 2]]) < 1.2).all(1) & (local[:, 1] > -0.12) & (local[:, 1] < 0.2)
        axis.plot(*local[near][:, [0, 2]].T, ".", color="#bbbbbb", markersize=1)
        for channels, color in ((clips.channels[index], "#3b6ea5"), (made[index], "#dd8452")):
            axis.plot(*channels[:, [0, 2]].T.numpy(), color=color)
            head = channels[::15, :3] + 0.15 * torch.linalg.cross(channels[::15, 3:6], channels[::15, 6:ROOT])
            axis.plot(*np.stack([channels[::15, [0, 2]].numpy(), head[:, [0, 2]].numpy()]).transpose(2, 0, 1), color=color, linewidth=0.8)
        axis.set(xlim=(-1.2, 1.2), ylim=(-1.2, 1.2), xticks=[], yticks=[], aspect="equal")
    return figures.pixels(figure)
