"""The quality page of long-term motion: losses, routes and bodies on held-out motion."""

import numpy as np
import torch
from jaxtyping import Float, UInt8

from pipeline.data import plots
from pipeline.data.qa import Check, Picture, captioned
from pipeline.geometry import rigid
from pipeline.longterm.clip_channels import Clips
from pipeline.longterm.examples import DatasetSplit, MotionDataset, encode_selection, select_clips
from pipeline.longterm.networks import ROOT_CHANNELS
from pipeline.longterm.plausibility import PlausibilityMeter
from stages.train_longterm.learning import TrainedLongTerm

SHOWN = 8
"""Clips in the top-down plots."""
TRIED = 60
"""Maximum number of held-out clips that are evaluated."""
CLIP_STRIDE = 15
"""Frames (30 fps) between the starts of held-out clips."""
STILLS = 12
"""Places at which static bodies are sampled."""
CANDIDATES = 4
"""Samples at each place, of which the best is kept."""
HEIGHT_IN, LINE_WIDTH = 5.4, 0.8
SHOWN_M, SLICE_M = 1.2, (-0.12, 0.2)
"""Half width of each plot, and the slice of scene heights drawn, relative to the root."""
ARROW_M, ARROW_FRAMES = 0.15, 15
"""Length of the heading lines, and frames between them."""
CAPTIONS = {
    "losses": "Loss of each network over its training, smoothed.",
    "routes": f"Routes (held out if any) in panels of {2 * SHOWN_M:g} m: true blue, made orange, scene gray.",
}


def evaluate_held_out(
    learned: TrainedLongTerm, dataset: DatasetSplit, seed: int
) -> tuple[list[Check], list[Picture]]:
    """Return checks and pictures of a model on held-out motion, or on training motion if none is held out."""
    where, kind = (dataset.held_out, "held-out") if dataset.held_out else (dataset.train, "training")
    rng = np.random.default_rng(seed)
    cuts = select_clips(where, rng, stride=CLIP_STRIDE, most=TRIED)
    clips = encode_selection(where, cuts, learned.model.poses, learned.model.sizes.points, rng)
    made = learned.model.between(clips.channels[:, 0], clips.channels[:, -1], clips.seen)
    line = torch.lerp(
        clips.channels[:, :1], clips.channels[:, -1:], torch.linspace(0, 1, made.shape[1])[None, :, None]
    )
    error, straight = (float((each - clips.channels)[..., :3].abs().mean()) for each in (made, line))
    gap, depth = _stills(learned, where, rng)
    explained = float(learned.model.poses.explained)
    checks = [
        Check(f"L1 of {kind} routes", 100 * error, "cm", 10.0),
        Check(f"L1 of {kind} routes against straight lines", error / max(straight, 1e-9), "", 0.9),
        Check("bodies at sub-goals: gap to the scene, median", 100 * gap, "cm", 2.0),
        Check("bodies at sub-goals: deepest vertex in the scene, median", 100 * depth, "cm", 4.0),
        Check("contact vertices found", len(learned.model.contacts.vertices), "", 10, 1, "higher"),
        Check("variance of poses that the pose space explains", explained, "share", 0.9, 0.5, "higher"),
    ]
    losses = plots.loss_curves({name: {"total": record.total()} for name, record in learned.records.items()})
    return checks, captioned(CAPTIONS, losses=losses, routes=routes(clips, made, where))


def _stills(learned: TrainedLongTerm, where: MotionDataset, rng: np.random.Generator) -> tuple[float, float]:
    """Return the median gap and the median penetration depth of bodies sampled at held-out places, meters."""
    stretch, scene = where.stretches[0], where.scenes[where.scene_of[0]]
    places = stretch.world_from_agent[np.linspace(0, len(stretch) - 1, STILLS).astype(int)]
    made = learned.model.bodies(places, where.body, scene, rng, candidates=CANDIDATES)
    meter = PlausibilityMeter(where.body, learned.model.contacts, scene.distance)
    gap, depth = meter.gap_and_penetration(made)
    return float(np.median(gap)), float(np.median(depth))


def routes(
    clips: Clips, made: Float[torch.Tensor, "clip frame channel"], where: MotionDataset
) -> UInt8[np.ndarray, "height width 3"]:
    """Plot some clips from above, in their own frames."""
    figure, axes = plots.panels(2, SHOWN // 2, width_in=10, height_in=HEIGHT_IN)
    for axis, index in zip(axes.ravel(), np.linspace(0, len(clips) - 1, SHOWN).astype(int), strict=True):
        points = where.scenes[clips.scene[index]].surface.points
        local = rigid.apply(rigid.inverse(clips.world_from_clip[index]), points)
        near = (local[:, 1] > SLICE_M[0]) & (local[:, 1] < SLICE_M[1])
        near &= (np.abs(local[:, [0, 2]]) < SHOWN_M).all(1)
        axis.plot(*local[near][:, [0, 2]].T, ".", color=plots.GRAY, markersize=1)
        for channels, color in ((clips.channels[index], plots.BLUE), (made[index], plots.ORANGE)):
            axis.plot(*channels[:, [0, 2]].T.numpy(), color=color)
            some = channels[::ARROW_FRAMES]
            head = some[:, :3] + ARROW_M * torch.linalg.cross(some[:, 3:6], some[:, 6:ROOT_CHANNELS])
            arrows = torch.stack([some[:, [0, 2]], head[:, [0, 2]]]).permute(2, 0, 1).numpy()
            axis.plot(*arrows, color=color, linewidth=LINE_WIDTH)
        axis.set(xlim=(-SHOWN_M, SHOWN_M), ylim=(-SHOWN_M, SHOWN_M), xticks=[], yticks=[], aspect="equal")
    return plots.pixels(figure)
