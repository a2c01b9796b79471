"""The animal's root in every frame: hypotheses from shape and localizer, Viterbi decoding over time,
smoothing.

In depth, front and back of an animal look alike; over time only one of the two walks head first.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.core.progress import track
from pipeline.data.clips import Clip, Masks
from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh
from pipeline.localization.localizer import Localizer
from stages.register_videos import agent_fit, headings
from stages.register_videos.agent_fit import AgentModel, AgentObservation, StandingSurface
from stages.register_videos.agent_tracking import Tracker
from stages.register_videos.config import RootConfig
from stages.register_videos.headings import RootHypotheses

HYPOTHESES, APART_DEG = 5, 25.0
"""Hypotheses per frame, at most, and least difference of their headings, degrees."""
COST_SCALE_M = 0.004
"""A pose worse by this costs one unit, metres."""
FINE_ROUNDS = 12
"""Gauss-Newton steps of the hypotheses that remain."""
LOCALIZER_EVERY_FRAMES, LOCALIZER_WEIGHT = 2, 8.0
"""The agent's localizer is queried in one visible frame of so many; a certain pose is worth so many units."""
MAX_LOCALIZED, LOCALIZER_SIGMA_RAD = 2, float(np.deg2rad(30.0))
"""Poses of the localizer that become hypotheses, and spread of the bonus around their heading, radians."""
SMOOTHING_PASSES, SMOOTHING_REACH = 2, 3
"""Passes of the smoothing, and its reach in time constants."""
OUTLIER_SCALE = (0.35, 0.1)
"""Deviation (radians, metres) at which a neighbour's weight is halved."""
MIN_SHARE, COST_DECAY_M, SLOPE_RIDGE_S2 = 0.05, 0.02, 1e-4
"""Weight of hardly visible frames, cost where weights are 1/e (metres), ridge on the slope (s^2)."""


@dataclass(frozen=True)
class Roots:
    """The animal's root per frame, NaN where it is not visible."""

    world_from_agent: Float[np.ndarray, "frame 4 4"]
    visible: Bool[np.ndarray, "frame"]
    cost_m: Float[np.ndarray, "frame"]
    """Cost of the pose (`agent_fit.cost`), metres; NaN where not visible."""
    share: Float[np.ndarray, "frame"]
    """Visible area over the area in full view, 0..1."""

    @staticmethod
    def unseen(frames: int) -> "Roots":
        """Return roots of a recording without a visible animal."""
        none, unknown = np.zeros(frames), np.full(frames, np.nan)
        return Roots(np.full((frames, 4, 4), np.nan), none > 0, unknown, none)


def find_roots(
    clip: Clip,
    masks: Masks,
    mesh: Mesh,
    standing: StandingSurface,
    localizer: Localizer,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    config: RootConfig,
    rng: np.random.Generator,
) -> Roots:
    """Find the animal's root in every frame that shows it."""
    model, roots = agent_fit.make_model(mesh, rng), Roots.unseen(len(clip))
    poses, cost, share = roots.world_from_agent, roots.cost_m, roots.share

    def observe(frame: int) -> AgentObservation | None:
        return agent_fit.observe(clip, masks[frame], frame, world_from_camera[frame], model, standing)

    hypotheses = []
    for frame in track(np.flatnonzero(masks.visible).tolist(), "placing the animal"):
        if (observation := observe(frame)) is not None:
            hypotheses.append(_hypotheses(clip, observation, model, localizer, len(hypotheses), config))
    if not hypotheses:
        return roots
    path = headings.choose(clip.timestamp_s, hypotheses)
    for each, chosen in track(list(zip(hypotheses, path, strict=True)), "refining the animal"):
        frame, observation = each.frame, observe(each.frame)
        assert observation is not None, frame
        start = each.world_from_agent[chosen][None]
        pose = agent_fit.fit_fine(observation, model, start, rounds=FINE_ROUNDS, tilt=True)
        poses[frame], share[frame] = pose[0], observation.share
        cost[frame] = agent_fit.cost(observation, model, pose)[0]
    poses, cost = Tracker(clip.timestamp_s, poses, cost, share, observe, model).track()
    smoothed = smooth(clip.timestamp_s, poses, cost, share, config.smooth_s)
    return Roots(smoothed, np.isfinite(cost), cost, share)


def _hypotheses(
    clip: Clip,
    observation: AgentObservation,
    model: AgentModel,
    localizer: Localizer,
    index: int,
    config: RootConfig,
) -> RootHypotheses:
    """Fit from all headings and from the localizer's poses; keep the best that differ."""
    start, answers = agent_fit.initial_poses(observation, model, config.headings), []
    if index % LOCALIZER_EVERY_FRAMES == 0:
        frame, depth = observation.frame, observation.depth
        lenses = clip.depth_intrinsics[frame], clip.intrinsics[frame]
        answers = localizer.localize(clip.color(frame), depth, *lenses, observation.mask)
    localized = [
        upright(observation.world_from_camera @ rigid.inverse(answer.map_from_camera))
        for answer in answers[:MAX_LOCALIZED]
    ]
    start = np.concatenate([start, localized]) if localized else start
    poses = agent_fit.fit_coarse(observation, model, start)
    distinct: list[int] = []
    for candidate in np.argsort(agent_fit.cost(observation, model, poses), kind="stable"):
        apart = np.abs(rigid.wrap(rigid.yaw(poses[distinct]) - rigid.yaw(poses[candidate])))
        if (apart > np.deg2rad(APART_DEG)).all():
            distinct.append(int(candidate))
    poses = agent_fit.fit_fine(
        observation, model, poses[distinct[:HYPOTHESES]], rounds=FINE_ROUNDS, tilt=False
    )
    cost = agent_fit.cost(observation, model, poses) / COST_SCALE_M
    bonus = np.zeros(len(poses))
    for answer in answers:
        world_from_agent = observation.world_from_camera @ rigid.inverse(answer.map_from_camera)
        turn = rigid.wrap(rigid.yaw(poses) - rigid.yaw(world_from_agent))
        bonus = np.maximum(bonus, answer.probability * np.exp(-((turn / LOCALIZER_SIGMA_RAD) ** 2)))
    return RootHypotheses(
        frame=observation.frame,
        world_from_agent=poses,
        cost=cost - LOCALIZER_WEIGHT * bonus,
        min_misfit=float(cost.min()),
        share=observation.share,
        middle_world=np.median(observation.points_world, axis=0),
        eye_world=observation.world_from_camera[:3, 3],
    )


def upright(world_from_agent: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Keep heading and position, drop the tilt."""
    return rigid.make(rigid.rotation_from_yaw(rigid.yaw(world_from_agent)), world_from_agent[:3, 3])


def smooth(
    timestamp_s: Float[np.ndarray, "frame"],
    world_from_agent: Float[np.ndarray, "frame 4 4"],
    cost_m: Float[np.ndarray, "frame"],
    share: Float[np.ndarray, "frame"],
    smooth_s: float,
) -> Float[np.ndarray, "frame 4 4"]:
    """Smooth visible roots by local linear regression on SE(3), weighted by closeness in time (``smooth_s``,
    seconds), cost (metres) and visibility; twice, robustly."""
    known = np.flatnonzero(np.isfinite(cost_m))
    result, time, best = world_from_agent.copy(), timestamp_s[known], np.nanmin(cost_m, initial=np.inf)
    low = np.searchsorted(time, time - SMOOTHING_REACH * smooth_s, side="right")
    high = np.searchsorted(time, time + SMOOTHING_REACH * smooth_s)
    for _ in range(SMOOTHING_PASSES):
        before = result.copy()
        for place, frame in enumerate(known):
            index = known[low[place] : high[place]]
            gap = timestamp_s[index] - timestamp_s[frame]
            offset = rigid.log(rigid.inverse(before[frame]) @ world_from_agent[index])
            outlier = np.linalg.norm(offset / np.repeat(OUTLIER_SCALE, 3), axis=1)
            weight = (
                np.exp(-0.5 * (gap / smooth_s) ** 2)
                * (MIN_SHARE + share[index])
                / (1 + outlier**2)
                * np.exp(-(cost_m[index] - best) / COST_DECAY_M)
            )
            total, first = weight.sum(), (weight * gap).sum()
            second = (weight * gap**2).sum() + SLOPE_RIDGE_S2 * total
            filtered = weight * (second - first * gap) / max(total * second - first**2, 1e-12)
            result[frame] = before[frame] @ rigid.exp(filtered @ offset)
    return result
