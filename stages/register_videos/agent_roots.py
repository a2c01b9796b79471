"""The animal's root pose in every frame: hypotheses by shape and localizer, Viterbi decoding, smoothing.

Depth alone does not distinguish front from back; over time only one of the two walks head first. Where depth
is not measured, outline and colors of the rendered template decide, also whether the animal stands on the map
or on the floor behind it. In the paper's form the localizer's pose of every frame is its root.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import assert_never

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.core.progress import track
from pipeline.data.clips import Clip, Masks
from pipeline.geometry import picture_fit, rigid, subsampling, viterbi
from pipeline.geometry.contact import StandingSurface
from pipeline.geometry.meshes import Mesh
from pipeline.localization.localizer import Localizer
from stages.register_videos import agent_fit, headings
from stages.register_videos.agent_fit import AgentModel, AgentObservation
from stages.register_videos.agent_tracking import Tracker
from stages.register_videos.config import RootConfig
from stages.register_videos.headings import RootHypotheses

MAX_HYPOTHESES, MIN_HEADING_DIFFERENCE_DEG = 5, 25.0
"""Largest number of hypotheses per frame, and least difference of their headings, degrees."""
COST_SCALE = 0.00667
"""Fit cost that counts as one unit of the Viterbi cost, body lengths."""
NEAR, SURFACE_CHANGE = 0.1, 4.0
"""Distance between positions on the map and on the floor behind it that makes a difference, body lengths;
cost of a change between them, units."""
CALIBRATION_FRAMES = 24
"""Frames from which typical residuals of pictures without depth are learned."""
FINE_ROUNDS = 12
"""Gauss-Newton steps of the remaining hypotheses."""
LOCALIZER_EVERY_FRAMES, LOCALIZER_WEIGHT = 2, 8.0
"""Stride of the frames in which the localizer is queried, and bonus of a certain pose, units of cost."""
MAX_LOCALIZED, LOCALIZER_SIGMA_RAD = 2, float(np.deg2rad(30.0))
"""Localizer poses that become hypotheses, and width of their bonus in heading, radians."""
SMOOTHING_PASSES, SMOOTHING_REACH = 2, 3
"""Passes of the smoothing, and its reach in time constants."""
OUTLIER_SCALE = (0.35, 0.167)
"""Residual (radians, body lengths) at which a neighbor's weight is halved."""
MIN_SHARE, COST_DECAY, SLOPE_RIDGE_S2 = 0.05, 0.0333, 1e-4
"""Least weight by visibility, cost scale of weights (body lengths), ridge on the slope (s^2)."""


@dataclass(frozen=True)
class Roots:
    """The animal's root per frame, NaN where it is not visible."""

    world_from_agent: Float[np.ndarray, "frame 4 4"]
    visible: Bool[np.ndarray, "frame"]
    cost: Float[np.ndarray, "frame"]
    """Cost of the pose (`agent_fit.cost`), body lengths; NaN where not visible."""
    share: Float[np.ndarray, "frame"]
    """Visible share, 0..1 (`AgentObservation.share`)."""
    facing: Float[np.ndarray, "frame"]
    """Probability that the heading is right."""

    @staticmethod
    def unseen(frames: int) -> "Roots":
        """Return roots of a recording without a visible animal."""
        none, unknown = np.zeros(frames), np.full(frames, np.nan)
        return Roots(np.full((frames, 4, 4), np.nan), none > 0, unknown, none, np.ones(frames))


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
    """Estimate the animal's root pose in every frame that shows it."""
    model, roots = agent_fit.make_model(mesh, rng), Roots.unseen(len(clip))
    poses, cost, share = roots.world_from_agent, roots.cost, roots.share
    surface: dict[int, StandingSurface] = {}

    def observe(frame: int, below: StandingSurface | None = None) -> AgentObservation | None:
        below = below or surface.get(frame, standing)
        return agent_fit.observe(clip, masks[frame], frame, world_from_camera[frame], model, below)

    if clip.mapped:
        model = _with_body(mesh, model, observe, np.flatnonzero(masks.visible), config)
    frames, hypotheses = track(np.flatnonzero(masks.visible).tolist(), "placing the animal"), []
    observations = (seen for frame in frames if (seen := observe(frame)) is not None)
    match config.initialization:
        case "headings":
            for each in observations:
                hypotheses.append(_hypotheses(clip, each, model, localizer, len(hypotheses), config))
        case "localizer":
            for each in observations:
                for pose, _ in _localized(clip, each, localizer)[:1]:
                    poses[each.frame], share[each.frame] = pose, each.share
                    cost[each.frame] = agent_fit.cost(each, model, pose[None])[0]
            return Roots(poses, np.isfinite(cost), cost, share, roots.facing)
        case _:
            assert_never(config.initialization)
    if not hypotheses:
        return roots
    if clip.mapped:
        floor, behind = standing.floor_alone, {}
        for index, each in enumerate(hypotheses):
            seen = observe(each.frame, floor)
            if seen is not None and _apart_m(seen, each) > NEAR * model.length_m:
                behind[each.frame] = _hypotheses(clip, seen, model, localizer, index, config)
        hypotheses = _standing_on(hypotheses, behind)
        surface = {each.frame: floor for each in hypotheses if each is behind.get(each.frame)}
    faced = headings.decode_headings(clip.timestamp_s, hypotheses, model.length_m)
    path = headings.choose_hypotheses(hypotheses, faced)
    for each, chosen in track(list(zip(hypotheses, path, strict=True)), "refining the animal"):
        frame, observation = each.frame, observe(each.frame)
        assert observation is not None, frame
        start = each.world_from_agent[chosen][None]
        pose = agent_fit.fit_fine(observation, model, start, rounds=FINE_ROUNDS, tilt=True)
        poses[frame], share[frame] = pose[0], observation.share
        cost[frame] = agent_fit.cost(observation, model, pose)[0]
    poses, cost = Tracker(clip.timestamp_s, poses, cost, share, observe, model).track()
    smoothed = smooth(clip.timestamp_s, poses, cost, share, config.smooth_s, model.length_m)
    seen = np.array([each.frame for each in hypotheses])
    facing = faced.probability_near(rigid.yaw(smoothed[seen]))
    facing = np.interp(np.arange(len(clip)), seen, np.nan_to_num(facing))
    return Roots(smoothed, np.isfinite(cost), cost, share, facing)


def _apart_m(seen: AgentObservation, other: RootHypotheses) -> float:
    return float(np.linalg.norm(np.median(seen.points_world, axis=0) - other.center_world))


def _standing_on(mapped: list[RootHypotheses], behind: dict[int, RootHypotheses]) -> list[RootHypotheses]:
    """Choose between the map's surface and the floor behind it (by frame), by a Viterbi path over costs.

    What was moved since the walk-through is still in the map. At the wrong depth, the animal's size is wrong.
    """
    pairs = [(each, behind.get(each.frame, each)) for each in mapped]
    cost = np.array([[each.cost.min() for each in pair] for pair in pairs])
    cost[0, 1] += SURFACE_CHANGE
    path = viterbi.viterbi_decode(cost, lambda _: SURFACE_CHANGE * (1 - np.eye(2)))
    return [pair[state] for pair, state in zip(pairs, path, strict=True)]


def _with_body(
    mesh: Mesh,
    model: AgentModel,
    observe: Callable[[int], AgentObservation | None],
    visible: Int[np.ndarray, "visible"],
    config: RootConfig,
) -> AgentModel:
    """Add the colored body; learn its typical residuals from rough fits to some of the visible frames."""
    body, pictures, poses = picture_fit.colored_body(mesh), [], []
    for frame in subsampling.some(visible, CALIBRATION_FRAMES).tolist():
        seen = observe(frame)
        if seen is not None and seen.picture is not None:
            fits = agent_fit.fit_coarse(seen, model, agent_fit.initial_poses(seen, model, config.headings))
            poses.append(fits[np.argmin([body.misfit(seen.picture, fit) for fit in fits])])
            pictures.append(seen.picture)
    return replace(model, body=picture_fit.calibrated(body, pictures, np.array(poses)) if poses else body)


def _hypotheses(
    clip: Clip,
    observation: AgentObservation,
    model: AgentModel,
    localizer: Localizer,
    index: int,
    config: RootConfig,
) -> RootHypotheses:
    """Fit from all headings and localizer poses; keep the best with distinct headings."""
    start, localized = agent_fit.initial_poses(observation, model, config.headings), []
    if index % LOCALIZER_EVERY_FRAMES == 0:
        localized = _localized(clip, observation, localizer)
    for pose, _ in localized[:MAX_LOCALIZED]:
        upright = rigid.make(rigid.rotation_from_yaw(rigid.yaw(pose)), pose[:3, 3])
        start = np.concatenate([start, upright[None]])
    poses = agent_fit.fit_coarse(observation, model, start)
    distinct: list[int] = []
    for candidate in np.argsort(agent_fit.cost(observation, model, poses), kind="stable"):
        heading_difference = np.abs(rigid.wrap(rigid.yaw(poses[distinct]) - rigid.yaw(poses[candidate])))
        if (heading_difference > np.deg2rad(MIN_HEADING_DIFFERENCE_DEG)).all():
            distinct.append(int(candidate))
    poses = agent_fit.fit_fine(
        observation, model, poses[distinct[:MAX_HYPOTHESES]], rounds=FINE_ROUNDS, tilt=False
    )
    cost = agent_fit.cost(observation, model, poses) / COST_SCALE
    bonus = np.zeros(len(poses))
    for world_from_agent, probability in localized:
        turn = rigid.wrap(rigid.yaw(poses) - rigid.yaw(world_from_agent))
        bonus = np.maximum(bonus, probability * np.exp(-((turn / LOCALIZER_SIGMA_RAD) ** 2)))
    return RootHypotheses(
        frame=observation.frame,
        world_from_agent=poses,
        cost=cost - LOCALIZER_WEIGHT * bonus,
        min_misfit=float(cost.min()),
        share=observation.share,
        center_world=np.median(observation.points_world, axis=0),
        eye_world=observation.world_from_camera[:3, 3],
    )


def _localized(
    clip: Clip, observation: AgentObservation, localizer: Localizer
) -> list[tuple[Float[np.ndarray, "4 4"], float]]:
    """Return the localizer's poses ``world_from_agent`` and their probabilities, best first."""
    frame, camera = observation.frame, observation.world_from_camera
    lenses = clip.depth_intrinsics[frame], clip.intrinsics[frame]
    estimates = localizer.localize(clip.color(frame), observation.depth, *lenses, observation.mask)
    return [(camera @ rigid.inverse(each.map_from_camera), each.probability) for each in estimates]


def smooth(
    timestamp_s: Float[np.ndarray, "frame"],
    world_from_agent: Float[np.ndarray, "frame 4 4"],
    cost: Float[np.ndarray, "frame"],
    share: Float[np.ndarray, "frame"],
    smooth_s: float,
    length_m: float,
) -> Float[np.ndarray, "frame 4 4"]:
    """Smooth visible roots by robust local linear regression on SE(3).

    Weights depend on time difference (``smooth_s``, seconds), cost, visibility, and residual in ``length_m``.
    """
    known, scale = np.flatnonzero(np.isfinite(cost)), np.repeat(OUTLIER_SCALE, 3) * ([1] * 3 + [length_m] * 3)
    result, time, best = world_from_agent.copy(), timestamp_s[known], np.nanmin(cost, initial=np.inf)
    low = np.searchsorted(time, time - SMOOTHING_REACH * smooth_s, side="right")
    high = np.searchsorted(time, time + SMOOTHING_REACH * smooth_s)
    for _ in range(SMOOTHING_PASSES):
        previous = result.copy()
        for row, frame in enumerate(known):
            index = known[low[row] : high[row]]
            gap = timestamp_s[index] - timestamp_s[frame]
            offset = rigid.log(rigid.inverse(previous[frame]) @ world_from_agent[index])
            outlier = np.linalg.norm(offset / scale, axis=1)
            weight = (
                np.exp(-0.5 * (gap / smooth_s) ** 2)
                * (MIN_SHARE + share[index])
                / (1 + outlier**2)
                * np.exp(-(cost[index] - best) / COST_DECAY)
            )
            total, first = weight.sum(), (weight * gap).sum()
            second = (weight * gap**2).sum() + SLOPE_RIDGE_S2 * total
            filtered = weight * (second - first * gap) / max(total * second - first**2, 1e-12)
            result[frame] = previous[frame] @ rigid.exp(filtered @ offset)
    return result
