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
from stages.register_videos.body import Body, FitOptions, Glimpse, Ground


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
    motion_weight: float = 8.0
    """Units for walking tail first at half a metre a second or more."""
    turn_deg: float = 20.0
    """A turn by this in a tenth of a second costs one unit ..."""
    flip_cost: float = 40.0
    """... up to so many units."""
    still_weight: float = 0.06
    """Weight of a frame in which neither animal nor phone moves, against one that shows something new."""
    step_m: float = 0.08
    """A step of this in a tenth of a second, beyond what its points did, costs one unit."""
    smooth_s: float = 0.15
    """Time constant of the smoothing, seconds."""
    gap_s: float = 0.5
    """Gaps in sight up to this are bridged, seconds."""


@dataclass(frozen=True)
class Roots:
    """The animal's root per frame, NaN where it is not visible."""

    world_from_agent: Float[np.ndarray, "frame 4 4"]
    visible: Bool[np.ndarray, "frame"]
    cost_m: Float[np.ndarray, "frame"]
    """How badly the placement explains what was seen, metres; NaN where not visible."""
    share: Float[np.ndarray, "frame"]
    """Visible area over the area in full view, 0..1."""


@dataclass(frozen=True)
class Candidates:
    """Placements of one frame and what each costs, in units."""

    frame: int
    world_from_agent: Float[np.ndarray, "candidate 4 4"]
    cost: Float[np.ndarray, "candidate"]


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
    body = bodies.make_body(mesh, options.fit, rng)
    count = len(clip)
    roots = np.full((count, 4, 4), np.nan)
    cost, share, visible = np.full(count, np.nan), np.zeros(count), np.zeros(count, bool)

    def look(frame: int) -> Glimpse | None:
        return bodies.observe(clip, masks[frame], frame, world_from_camera[frame], body, ground, options.fit)

    candidates, moments = [], []
    for frame in track(np.flatnonzero(masks.visible).tolist(), "placing the animal"):
        if (glimpse := look(frame)) is not None:
            candidates.append(_candidates(clip, glimpse, body, localizer, len(candidates), options))
            moments.append(Moment(frame, np.median(glimpse.points_world, axis=0), glimpse.world_from_camera[:3, 3]))
    if not candidates:
        return Roots(roots, visible, cost, share)
    path = best_path(clip.timestamp_s, candidates, pace(clip.timestamp_s, moments, options.still_weight), options)
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
    return Candidates(glimpse.frame, placed, cost - options.localizer_weight * bonus)


def heading(world_from_agent: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch"]:
    """Return the angle of the head's direction (+z) about +y, radians."""
    return np.arctan2(world_from_agent[..., 0, 2], world_from_agent[..., 2, 2])


def upright(world_from_agent: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Keep the heading and the place, drop the tilt."""
    return rigid.make(rigid.rotation_from_vector(heading(world_from_agent) * bodies.UP), world_from_agent[:3, 3])


def wrap(angle: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    """Bring angles to -pi..pi."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


@dataclass(frozen=True)
class Moment:
    """What is kept of a glimpse: pictures are read again when they are needed again, so that memory stays small."""

    frame: int
    middle_world: Float[np.ndarray, "3"]
    """Of the animal's seen points."""
    eye_world: Float[np.ndarray, "3"]


@dataclass(frozen=True)
class Pace:
    """How things moved around each glimpse."""

    velocity: Float[np.ndarray, "glimpse 3"]
    """Horizontal velocity of the seen points' middle, m/s; zero across gaps."""
    novelty: Float[np.ndarray, "glimpse"]
    """0..1: how much a glimpse shows that its neighbours did not; repeated views err alike."""


def pace(timestamp_s: Float[np.ndarray, "frame"], moments: list[Moment], still_weight: float, span: int = 3) -> Pace:
    """Measure motion over ``span`` glimpses before and after each."""
    middle = np.stack([moment.middle_world for moment in moments]) * (1, 0, 1)
    phone = np.stack([moment.eye_world for moment in moments])
    time = timestamp_s[[moment.frame for moment in moments]]
    before, after = np.maximum(np.arange(len(time)) - span, 0), np.minimum(np.arange(len(time)) + span, len(time) - 1)
    elapsed = np.maximum(time[after] - time[before], 1e-3)[:, None]
    velocity = (middle[after] - middle[before]) / elapsed
    moved = np.linalg.norm(velocity, axis=1) + 0.5 * np.linalg.norm((phone[after] - phone[before]) / elapsed, axis=1)
    velocity[(elapsed[:, 0] > 1.2) | (elapsed[:, 0] < 0.15)] = 0
    novelty = still_weight + (1 - still_weight) * np.minimum(moved / 0.4, 1.0)
    return Pace(velocity, novelty)


def best_path(timestamp_s: Float[np.ndarray, "frame"], candidates: list[Candidates], moves: Pace, options: RootOptions) -> list[int]:
    """Choose one candidate per glimpse by dynamic programming: fit, walking head first, no sudden turns or jumps."""
    totals, back = [_own_cost(candidates[0], moves, 0, options)], []
    for index in range(1, len(candidates)):
        elapsed = timestamp_s[candidates[index].frame] - timestamp_s[candidates[index - 1].frame]
        step = totals[-1][:, None] + _link_cost(candidates[index - 1], candidates[index], moves.velocity[index], elapsed, options)
        back.append(step.argmin(0))
        totals.append(step.min(0) + _own_cost(candidates[index], moves, index, options))
    path = [int(totals[-1].argmin())]
    for pointers in reversed(back):
        path.append(int(pointers[path[-1]]))
    return path[::-1]


def _own_cost(candidates, moves, index, options):
    velocity, cost = moves.velocity[index], moves.novelty[index] * (candidates.cost - candidates.cost.min())
    speed = np.linalg.norm(velocity)
    if speed < 0.2:
        return cost
    ahead = np.cos(heading(candidates.world_from_agent) - np.arctan2(velocity[0], velocity[2]))
    return cost + options.motion_weight * min(speed / 0.5, 1.0) * (1 - ahead) / 2


def _link_cost(before, after, velocity, elapsed, options):
    tenths = max(elapsed / 0.1, 1.0)
    turn = wrap(heading(before.world_from_agent)[:, None] - heading(after.world_from_agent)[None])
    jump = after.world_from_agent[None, :, :3, 3] - before.world_from_agent[:, None, :3, 3] - velocity * elapsed
    turned = (turn / (np.deg2rad(options.turn_deg) * np.sqrt(tenths))) ** 2
    jumped = (np.linalg.norm(jump, axis=-1) / (options.step_m * tenths)) ** 2
    return np.minimum(turned, options.flip_cost / np.sqrt(tenths)) + np.minimum(jumped, 6.0)


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
