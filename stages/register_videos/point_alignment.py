"""Bundle adjustment of a session's cameras against the walk-through's fixed cameras, by shared SIFT points.

It helps recordings without device odometry; device odometry is more accurate than such matches.
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
from pipeline.mapping.bundle_adjustment import PointTerm, build_tracks

POINTS, PEAK_THRESHOLD = 1200, 0.02
"""SIFT points per picture, at most, and contrast threshold; plain walls need a low one."""
MAX_POINTS, MIN_POINTS = 2_400_000, 120
"""Points per recording, at most, which bounds memory, and least number per frame."""
MASK_MARGIN_PX = 15
"""Side of the square that dilates the agent's mask, pixels, by SIFT's support."""
PICTURES = 80
"""Pictures of the walk-through, at most."""
MATCHED_PICTURES, MIN_SHARED = 6, 0.15
"""Pictures matched with each frame, and least covisibility: share of the frame's points in view times the
cosine between optical axes."""
REACH_SHARE, REACH_M = 0.03, 0.15
"""Largest reprojection error (share of the picture's width) and depth error (meters) of matches."""


@dataclass(frozen=True)
class Walkthrough:
    """The walk-through and the cameras of its keyframes, its most accurate ones."""

    clip: Clip
    world_from_camera: Float[np.ndarray, "frame 4 4"]
    """NaN where a frame is not registered or not a keyframe."""


class WalkthroughTerm:
    """`PoseTerm` of points that a session shares with the walk-through."""

    def __init__(
        self, clip: Clip, masks: Masks, world_from_camera: Float[np.ndarray, "frame 4 4"], walk: Walkthrough
    ):
        """Match all frames with pictures of the walk-through, guided by the current cameras."""
        known = subsampling.some(np.flatnonzero(np.isfinite(walk.world_from_camera[:, 0, 0])), PICTURES)
        self._walked = walk.world_from_camera[known]
        poses = np.concatenate([world_from_camera, self._walked])
        pinholes = np.concatenate([clip.intrinsics, walk.clip.intrinsics[known]])
        walked = [_points(walk.clip, int(frame), POINTS) for frame in known]
        max_points = min(POINTS, max(MAX_POINTS // len(clip), MIN_POINTS))
        pixels, depths, links = [], [], []
        for frame in track(range(len(clip)), "points"):
            points = _points(clip, frame, max_points, masks[frame] > 0)
            pixel = cameras.project(points.points_camera, pinholes[frame])[0]
            world = rigid.apply(poses[frame], points.points_camera)
            overlap = [
                _visible_share(world, pose, lens, walk.clip.color_size) * (pose[:3, 2] @ poses[frame, :3, 2])
                for pose, lens in zip(self._walked, pinholes[len(clip) :], strict=True)
            ]
            for key in np.argsort(-np.array(overlap), kind="stable")[:MATCHED_PICTURES]:
                if overlap[key] > MIN_SHARED:
                    pairs = sift.matches(points.descriptors, walked[key].descriptors)
                    frame_rows, walk_rows = pairs.T
                    frame_from_walked = rigid.inverse(poses[frame]) @ self._walked[key]
                    points_frame = rigid.apply(frame_from_walked, walked[key].points_camera[walk_rows])
                    off_px = cameras.project(points_frame, pinholes[frame])[0] - pixel[frame_rows]
                    near = np.linalg.norm(off_px, axis=1) < REACH_SHARE * clip.color_size[1]
                    near &= np.abs(points_frame[:, 2] - points.points_camera[frame_rows, 2]) < REACH_M
                    links.append((frame, len(clip) + int(key), pairs[near]))
            pixels.append(pixel)
            depths.append(points.points_camera[:, 2])
        for each, lens in zip(walked, pinholes[len(clip) :], strict=True):
            pixels.append(cameras.project(each.points_camera, lens)[0])
            depths.append(each.points_camera[:, 2])
        lens = np.repeat([0, 1], [len(clip), len(known)])
        tracked = build_tracks(pixels, depths, pinholes, lens, links)
        self._points = PointTerm(tracked, poses)

    def normal_equations(
        self, world_from_camera: Float[np.ndarray, "frame 4 4"]
    ) -> tuple[sparse.csc_array, Float[np.ndarray, "parameter"]]:
        """Return matrix and gradient for the session's cameras."""
        size = 6 * len(world_from_camera)
        normal, gradient = self._points.normal_equations(np.concatenate([world_from_camera, self._walked]))
        return normal[:size, :size], gradient[:size]


def _points(clip, frame, max_points, agent=None) -> sift.SiftPoints:
    """Return a frame's SIFT points with depth, outside the agent's mask."""
    gray, depth = cv2.cvtColor(clip.color(frame), cv2.COLOR_RGB2GRAY), usable_depth(clip, frame)
    free = None if agent is None else cv2.erode((~agent).astype(np.uint8), np.ones((MASK_MARGIN_PX,) * 2))
    lenses = clip.intrinsics[frame], depth, clip.depth_intrinsics[frame]
    return sift.lift(sift.describe(gray, max_points, PEAK_THRESHOLD, free), *lenses)


def _visible_share(points_world, world_from_camera, intrinsics, size) -> float:
    """Return the share of points that project into a camera's picture."""
    pixel, z = cameras.project(rigid.apply(rigid.inverse(world_from_camera), points_world), intrinsics)
    return cameras.in_picture(pixel, z, size).sum() / max(len(z), 1)
