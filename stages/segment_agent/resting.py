"""Find an animal that rests for a whole session, given a user's prompt.

In the prompted frame, GrabCut segments it from what lies near the prompt and above the ground. Its points
there fill voxels, which locate it in other frames. Occluded sides are found later by its appearance.
"""

import math

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.core.errors import InputError
from pipeline.data.clips import Clip, usable_depth
from pipeline.geometry import cameras, rigid
from pipeline.segmentation.grabcut import grabcut
from stages.segment_agent import free_space, movers
from stages.segment_agent.evidence import EvidenceOf
from stages.segment_agent.free_space import References
from stages.segment_agent.movers import PlacedPrompt
from stages.segment_agent.turnaround import CLEARANCE_M, cluster_evidence, find_cluster, surroundings
from stages.segment_agent.windows import Sphere, crop_window, working_picture

PROMPT_RADIUS_M, SURE_RADIUS_M = 0.1, 0.05
"""radius around a prompt for the resting test; radius within which points above ground are surely animal"""
MIN_SIDE_PX = 240
"""smaller pictures are upsampled to this: GrabCut over-smooths small regions"""
MIN_PX = 30
"""minimum pixels of animal and of background for GrabCut"""


def is_resting(
    clip: Clip,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    references: References,
    prompt: PlacedPrompt,
) -> bool:
    """Return whether the prompted object stays there: few other frames see through it."""
    depth = usable_depth(clip, prompt.frame, keep_steps=False)
    points = cameras.back_project(depth, clip.depth_intrinsics[prompt.frame])[depth > 0]
    points = rigid.apply(world_from_camera[prompt.frame], points)
    points = points[np.linalg.norm(points - prompt.center_world, axis=1) < PROMPT_RADIUS_M]
    through = movers.moving(free_space.vote(references, points, prompt.frame))
    return bool(through.sum() < 0.5 * len(points))


def find_resting(
    clip: Clip,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    prompt: PlacedPrompt,
    height_px: int,
    rng: np.random.Generator,
) -> tuple[list[Sphere | None], EvidenceOf]:
    """Locate what rests where a prompt points; return a sphere per frame and its evidence. World: +y up.

    Raises InputError MSK-003 if nothing stands out from the ground there.
    """
    _, ground = surroundings(clip, world_from_camera, prompt.center_world)
    pose = world_from_camera[prompt.frame]
    shown = None if ground is None else _segment_prompted_points(clip, pose, prompt, ground, height_px, rng)
    if ground is None or shown is None:
        where = f"{clip.folder}, frame {prompt.frame}"
        remedy = "point at the middle of the animal, or draw a box, in a frame that shows the ground too"
        what = "nothing stands out from level ground where the prompt points"
        raise InputError("MSK-003", what, where, remedy)
    cluster = find_cluster(shown, prompt.center_world, min_hits=1)
    return [cluster.sphere] * len(clip), cluster_evidence(cluster, ground, whole=False)


def _segment_prompted_points(clip, world_from_camera, prompt, ground, height_px, rng):
    """Return the points of the animal that the prompted frame shows, in the world; None if hardly any."""
    color = working_picture(clip, prompt.frame, height_px)
    sphere = Sphere(prompt.center_world, 2 * prompt.reach_m)
    window = crop_window(clip, prompt.frame, world_from_camera, sphere, color)
    if window is None:
        return None
    away_m = np.linalg.norm(window.points_world - prompt.center_world, axis=-1)
    raised = ground.above(window.points_world) > CLEARANCE_M
    possible, sure = raised & (away_m < prompt.reach_m), raised & (away_m < SURE_RADIUS_M)
    if not sure.any() or min(possible.sum(), (~possible).sum()) < MIN_PX:
        return None
    trimap = np.where(sure, cv2.GC_FGD, np.where(possible, cv2.GC_PR_FGD, cv2.GC_BGD)).astype(np.uint8)
    scale = math.ceil(MIN_SIDE_PX / min(trimap.shape))
    large = cv2.resize(window.color, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    seeds = cv2.resize(trimap, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)
    found = grabcut(large, seeds, rng).astype(np.float32)
    inside = cv2.resize(found, trimap.shape[::-1], interpolation=cv2.INTER_AREA) > 0.5
    _, part = cv2.connectedComponents(inside.astype(np.uint8))
    shown = (part > 0) & np.isin(part, part[sure]) & possible & window.trusted
    return window.points_world[shown] if shown.sum() >= MIN_PX else None
