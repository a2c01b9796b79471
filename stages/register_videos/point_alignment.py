"""Points that a session's pictures and the walk-through's show: a bundle adjustment of the session's cameras
against the walk-through's, which stay.

A phone that tracks itself is surer than single pictures of the walk-through; other recordings gain.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from scipy import sparse

from pipeline.core.progress import track
from pipeline.data.clips import Clip, Masks, usable_depth
from pipeline.geometry import cameras, rigid, subsampling
from pipeline.mapping import sift
from pipeline.mapping.bundle_adjustment import PointTerm, chained

POINTS, PEAK_THRESHOLD = 1200, 0.02
"""Points of a picture at most, and SIFT's contrast threshold; plain walls need a low one."""
MAX_POINTS, MIN_POINTS = 2_400_000, 120
"""Points of a recording at most, so that memory stays bounded, and least number per frame."""
MASK_MARGIN_PX = 15
"""The agent's mask is widened by a square of this size, pixels: SIFT looks at neighbourhoods."""
PICTURES = 80
"""Pictures of the walk-through that are described, at most."""
MATCHED, MIN_SHARED = 6, 0.15
"""Pictures that a frame is matched with, those that show most of its points, and the least share of them,
times the cosine between both axes."""
REACH_SHARE, REACH_M = 0.03, 0.15
"""Matches lie as near where present cameras place them: share of the picture's width, metres of depth."""


@dataclass(frozen=True)
class Walk:
    """The walk-through and the cameras of its keyframes, which are more exact than those between them."""

    clip: Clip
    world_from_camera: Float[np.ndarray, "frame 4 4"]
    """NaN where a frame is not registered or no keyframe."""


class WalkTerm:
    """Errors of points that a session shares with the walk-through, as a `PoseTerm`."""

    def __init__(
        self, clip: Clip, masks: Masks, world_from_camera: Float[np.ndarray, "frame 4 4"], walk: Walk
    ):
        """Match all frames with pictures of the walk-through from the present cameras."""
        known = np.flatnonzero(np.isfinite(walk.world_from_camera[:, 0, 0]))
        known = known[subsampling.evenly(len(known), PICTURES)]
        self._walked = walk.world_from_camera[known]
        poses = np.concatenate([world_from_camera, self._walked])
        pinholes = np.concatenate([clip.intrinsics, walk.clip.intrinsics[known]])
        walked = [_points(walk.clip, int(frame), POINTS) for frame in known]
        most = min(POINTS, max(MAX_POINTS // len(clip), MIN_POINTS))
        pixels, depths, links = [], [], []
        for frame in track(range(len(clip)), "points"):
            points = _points(clip, frame, most, masks[frame] > 0)
            pixel = cameras.project(points.points_camera, pinholes[frame])[0]
            world = rigid.apply(poses[frame], points.points_camera)
            seen = [
                _seen(world, pose, lens, walk.clip.color_size) * (pose[:3, 2] @ poses[frame, :3, 2])
                for pose, lens in zip(self._walked, pinholes[len(clip) :], strict=True)
            ]
            for key in np.argsort(-np.array(seen), kind="stable")[:MATCHED]:
                if seen[key] > MIN_SHARED:
                    pairs = sift.matches(points.descriptors, walked[key].descriptors)
                    mine, theirs = pairs.T
                    frame_from_walked = rigid.inverse(poses[frame]) @ self._walked[key]
                    met = rigid.apply(frame_from_walked, walked[key].points_camera[theirs])
                    off_px = cameras.project(met, pinholes[frame])[0] - pixel[mine]
                    near = np.linalg.norm(off_px, axis=1) < REACH_SHARE * clip.color_size[1]
                    near &= np.abs(met[:, 2] - points.points_camera[mine, 2]) < REACH_M
                    links.append((frame, len(clip) + int(key), pairs[near]))
            pixels.append(pixel)
            depths.append(points.points_camera[:, 2])
        for each, lens in zip(walked, pinholes[len(clip) :], strict=True):
            pixels.append(cameras.project(each.points_camera, lens)[0])
            depths.append(each.points_camera[:, 2])
        lens = np.repeat([0, 1], [len(clip), len(known)])
        tracked = chained(pixels, depths, pinholes, lens, links)
        self._points = PointTerm(tracked, poses)

    def normal_equations(
        self, world_from_camera: Float[np.ndarray, "frame 4 4"]
    ) -> tuple[sparse.csc_array, Float[np.ndarray, "parameter"]]:
        """Return matrix and gradient for the session's cameras."""
        size = 6 * len(world_from_camera)
        normal, gradient = self._points.normal_equations(np.concatenate([world_from_camera, self._walked]))
        return normal[:size, :size], gradient[:size]


def _points(clip, frame, most, agent=None) -> sift.SiftPoints:
    """Describe a frame beside the agent."""
    gray, depth = cv2.cvtColor(clip.color(frame), cv2.COLOR_RGB2GRAY), usable_depth(clip, frame)
    free = None if agent is None else cv2.erode((~agent).astype(np.uint8), np.ones((MASK_MARGIN_PX,) * 2))
    lenses = clip.intrinsics[frame], depth, clip.depth_intrinsics[frame]
    return sift.lift(sift.describe(gray, most, PEAK_THRESHOLD, free), *lenses)


def _seen(points_world, world_from_camera, intrinsics, size) -> float:
    """Return the share of points in a camera's picture."""
    pixel, z = cameras.project(rigid.apply(rigid.inverse(world_from_camera), points_world), intrinsics)
    return cameras.in_picture(pixel, z, size).sum() / max(len(z), 1)
