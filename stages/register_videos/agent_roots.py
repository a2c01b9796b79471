"""The animal's root in every frame: hypotheses from shape and localizer, the best path through them, smoothing.

Front and back of an animal look alike to depth; over time only one of the two walks head first.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float

from pipeline.files.clips import Clip, Masks
from pipeline.models.localizer import Localizer
from pipeline.progress import track
from pipeline.space import rigid
from pipeline.space.meshes import Mesh
from stages.register_videos import body as bodies
from stages.register_videos import headings
from stages.register_videos.body import Body, FitOptions, Glimpse, Ground
from stages.register_videos.headings import Candidates, HeadingOptions, heading, wrap


@dataclass(frozen=True)
class RootOptions:
    """How hypotheses are kept, linked and smoothed."""

    fit: FitOptions = field(default_factory=FitOptions)
    """How the body is fitted."""
    kept: int = 5
    """Hypotheses kept per frame ..."""
    apart_deg: float = 25.0
    """... whose headings differ by at least this, degrees."""
    localizer_every_frames: int = 2
    """The agent's localizer is asked in one visible frame of so many."""
    cost_scale_m: float = 0.004
    """A placement worse by this costs one unit."""
    localizer_weight: float = 8.0
    """Units that a certain answer of the localizer is worth."""
    path: HeadingOptions = field(default_factory=HeadingOptions)
    """How one of them is chosen over time."""
    smooth_s: float = 0.15
    """Time constant of the smoothing, seconds."""


@dataclass(frozen=True)
class Roots:
    """The animal's root per frame, NaN where it is not visible."""

    world_from_agent: Float[np.ndarray, "frame 4 4"]
    visible: Bool[np.ndarray, "frame"]
    cost_m: Float[np.ndarray, "frame"]
    """How badly the placement explains what was seen, metres; NaN where not visible."""
    share: Float[np.ndarray, "frame"]
    """Visible area over the area in full view, 0..1."""

    @staticmethod
    def unseen(frames: int) -> "Roots":
        """Return the roots of a recording in which no animal was looked for, or none was seen."""
        return Roots(np.full((frames, 4, 4), np.nan), np.zeros(frames, bool), np.full(frames, np.nan), np.zeros(frames))


def find_roots(
    clip: Clip,
    masks: Masks,
    mesh: Mesh,
    ground: Ground,
    localizer: Localizer,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    options: RootOptions,
    rng: np.random.Generator,
) -> Roots:
    """Find the animal's root in every frame that shows it."""
    body, found = bodies.make_body(mesh, options.fit, rng), Roots.unseen(len(clip))
    roots, visible, cost, share = found.world_from_agent, found.visible, found.cost_m, found.share

    def look(frame: int) -> Glimpse | None:
        return bodies.observe(clip, masks[frame], frame, world_from_camera[frame], body, ground, options.fit)

    candidates = []
    for frame in track(np.flatnonzero(masks.visible).tolist(), "placing the animal"):
        if (glimpse := look(frame)) is not None:
            candidates.append(_candidates(clip, glimpse, body, localizer, len(candidates), options))
    if not candidates:
        return found
    path = headings.choose(clip.timestamp_s, candidates, options.path)
    for candidate, chosen in track(list(zip(candidates, path, strict=True)), "refining the animal"):
        glimpse = look(candidate.frame)
        placed = bodies.fit_fine(glimpse, body, candidate.world_from_agent[chosen][None], options.fit, tilt=True)
        roots[glimpse.frame], visible[glimpse.frame], share[glimpse.frame] = placed[0], True, glimpse.share
        cost[glimpse.frame] = bodies.cost(glimpse, body, placed, options.fit)[0]
    return Roots(smooth(clip.timestamp_s, roots, cost, share, options), visible, cost, share)


def _candidates(clip: Clip, glimpse: Glimpse, body: Body, localizer: Localizer, index: int, options: RootOptions) -> Candidates:
    """Fit from all headings and from the localizer's answers; keep the best that differ."""
    start, answers = bodies.starts(glimpse, body, options.fit.headings), []
    if index % options.localizer_every_frames == 0:
        frame = glimpse.frame
        answers = localizer.localize(clip.color(frame), glimpse.depth, clip.depth_intrinsics[frame], clip.intrinsics[frame], glimpse.mask)
    told = [upright(glimpse.world_from_camera @ rigid.inverse(answer.map_from_camera)) for answer in answers[:2]]
    placed = bodies.fit_coarse(glimpse, body, np.concatenate([start, told]) if told else start, options.fit)
    kept: list[int] = []
    for candidate in np.argsort(bodies.cost(glimpse, body, placed, options.fit), kind="stable"):
        apart = np.abs(wrap(heading(placed[kept]) - heading(placed[candidate])))
        if (apart > np.deg2rad(options.apart_deg)).all():
            kept.append(int(candidate))
    placed = bodies.fit_fine(glimpse, body, placed[kept[: options.kept]], options.fit, tilt=False)
    cost = bodies.cost(glimpse, body, placed, options.fit) / options.cost_scale_m
    bonus = np.zeros(len(placed))
    for answer in answers:
        turned = wrap(heading(placed) - heading(glimpse.world_from_camera @ rigid.inverse(answer.map_from_camera)))
        bonus = np.maximum(bonus, answer.probability * np.exp(-((turned / np.deg2rad(30)) ** 2)))
    return Candidates(
        frame=glimpse.frame,
        world_from_agent=placed,
        cost=cost - options.localizer_weight * bonus,
        least_misfit=float(cost.min()),
        share=glimpse.share,
        middle_world=np.median(glimpse.points_world, axis=0),
        eye_world=glimpse.world_from_camera[:3, 3],
    )


def upright(world_from_agent: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Keep the heading and the place, drop the tilt."""
    return rigid.make(rigid.rotation_from_vector(heading(world_from_agent) * bodies.UP), world_from_agent[:3, 3])


def smooth(
    timestamp_s: Float[np.ndarray, "frame"],
    world_from_agent: Float[np.ndarray, "frame 4 4"],
    cost_m: Float[np.ndarray, "frame"],
    share: Float[np.ndarray, "frame"],
    options: RootOptions,
) -> Float[np.ndarray, "frame 4 4"]:
    """Replace each visible root by a local line through its neighbours, weighted by closeness in time, fit and
    visibility; twice, robustly.
    """
    known = np.flatnonzero(np.isfinite(cost_m))
    result, time, best = world_from_agent.copy(), timestamp_s[known], np.nanmin(cost_m, initial=np.inf)
    low = np.searchsorted(time, time - 3 * options.smooth_s, side="right")
    high = np.searchsorted(time, time + 3 * options.smooth_s)
    for _ in range(2):
        before = result.copy()
        for place, frame in enumerate(known):
            index = known[low[place] : high[place]]
            gap = timestamp_s[index] - timestamp_s[frame]
            offset = rigid.log(rigid.inverse(before[frame]) @ world_from_agent[index])
            strange = np.linalg.norm(offset / ([0.35] * 3 + [0.1] * 3), axis=1)
            weight = (
                np.exp(-0.5 * (gap / options.smooth_s) ** 2)
                * (0.05 + share[index])
                / (1 + strange**2)
                * np.exp(-(cost_m[index] - best) / 0.02)
            )
            moment = np.array([weight.sum(), (weight * gap).sum(), (weight * gap**2).sum() + 1e-4 * weight.sum()])
            slope = moment[2] - moment[1] * gap
            share_of = weight * slope / max(moment[0] * moment[2] - moment[1] ** 2, 1e-12)
            result[frame] = before[frame] @ rigid.exp(share_of @ offset)
    return result
