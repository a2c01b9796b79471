"""Find an animal that rests all session long where a user points at it: only the hint separates it.

In the hinted frame GrabCut cuts it out of what lies near the hint and above the ground; its points there fill
cells, which show it in other frames. Of sides that were turned away nothing is known; its appearance, once
learned, finds them.
"""

import math

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.core.errors import InputError
from pipeline.data.clips import Clip
from pipeline.geometry import cameras, rigid
from stages.segment_agent import free_space, movers
from stages.segment_agent.evidence import Judge
from stages.segment_agent.follow import grab
from stages.segment_agent.free_space import References
from stages.segment_agent.movers import Hint
from stages.segment_agent.turnaround import CLEARANCE_M, find_cluster, judge_standing, surroundings
from stages.segment_agent.windows import Sphere, cut, working_picture

POINTED_M, SURELY_M = 0.1, 0.05
"""around its place lies what a hint points at; nearer, and above the ground, it surely is the animal"""
GRABBED_PX = 240
"""smallest side of a picture to cut out of: below, GrabCut's outline costs more than what it encloses"""
MIN_PX = 30
"""pixels of the animal, and of what is not, without which it cannot be cut out"""


def rests(
    clip: Clip, world_from_camera: Float[np.ndarray, "frame 4 4"], references: References, hint: Hint
) -> bool:
    """Return whether what a hint points at stays there: few other frames see through it."""
    depth = free_space.steady_depth(clip, hint.frame)
    points = cameras.back_project(depth, clip.depth_intrinsics[hint.frame])[depth > 0]
    points = rigid.apply(world_from_camera[hint.frame], points)
    points = points[np.linalg.norm(points - hint.centre_world, axis=1) < POINTED_M]
    through = movers.moving(free_space.vote(references, points, hint.frame))
    return bool(through.sum() < 0.5 * len(points))


def find_resting(
    clip: Clip,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    hint: Hint,
    height_px: int,
    rng: np.random.Generator,
) -> tuple[list[Sphere | None], Judge]:
    """Locate what rests at a hint; return a ball per frame and the judge of its points. World: +y up.

    Raises InputError MSK-003 when nothing stands out from the ground there.
    """
    _, ground = surroundings(clip, world_from_camera, hint.centre_world)
    pose = world_from_camera[hint.frame]
    shown = None if ground is None else _cut_out(clip, pose, hint, ground, height_px, rng)
    if ground is None or shown is None:
        where = f"{clip.folder}, frame {hint.frame}"
        remedy = "point at the middle of the animal, or draw a box, in a frame that shows the ground too"
        what = "nothing stands out from level ground where the hint points"
        raise InputError("MSK-003", what, where, remedy)
    cluster = find_cluster(shown, hint.centre_world, min_hits=1)
    return [cluster.ball] * len(clip), judge_standing(cluster, ground, whole=False)


def _cut_out(clip, world_from_camera, hint, ground, height_px, rng):
    """Return the points of the animal that the hinted frame shows, in the world; None if hardly any."""
    color = working_picture(clip, hint.frame, height_px)
    window = cut(clip, hint.frame, world_from_camera, Sphere(hint.centre_world, 2 * hint.reach_m), color)
    if window is None:
        return None
    away_m = np.linalg.norm(window.points_world - hint.centre_world, axis=-1)
    raised = ground.above(window.points_world) > CLEARANCE_M
    possible, surely = raised & (away_m < hint.reach_m), raised & (away_m < SURELY_M)
    if not surely.any() or min(possible.sum(), (~possible).sum()) < MIN_PX:
        return None
    marks = np.where(surely, cv2.GC_FGD, np.where(possible, cv2.GC_PR_FGD, cv2.GC_BGD)).astype(np.uint8)
    _, part = cv2.connectedComponents(_grab(window.color, marks, rng).astype(np.uint8))
    shown = (part > 0) & np.isin(part, part[surely]) & possible & window.trusted
    return window.points_world[shown] if shown.sum() >= MIN_PX else None


def _grab(color, marks, rng):
    """Cut out of a picture that is enlarged where it is small."""
    scale = math.ceil(GRABBED_PX / min(marks.shape))
    large = cv2.resize(color, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    found = grab(large, cv2.resize(marks, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST), rng)
    return cv2.resize(found.astype(np.float32), marks.shape[::-1], interpolation=cv2.INTER_AREA) > 0.5
