"""The held-out phone of a real capture: its cameras from clicks, else from registration; what it measured
stands for truth.

Its own depth sensor is compared with, as the paper does; without masks animal and room are not judged apart.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.core.videos import Video
from pipeline.data.clips import Clip, usable_depth
from pipeline.geometry import rigid, subsampling
from pipeline.localization import localizer as localizers
from stages.evaluate import reading
from stages.evaluate.clicked import Clicked, all_cameras
from stages.evaluate.heldout import NAMES, RANGE_M, HeldoutShot
from stages.evaluate.reading import BuildFolders

LOCALIZED = 40
"""frames that vote where registration places the phone"""
AGREE = (5.0, 0.2)
"""degrees and meters within which two frames mean the same place"""
MIN_VOTES = 4
UNPLACED = "the held-out phone was neither clicked (`make annotate`) nor could registration place it"
NO_MASKS = "the held-out phone of a real capture has no masks"
PARTS_WITHOUT_MASKS = tuple(name for name in NAMES if name.endswith(("_agent", "_scene")))


def cameras_of(
    folders: BuildFolders, video: Video, clicked: Clicked | None, device: str
) -> tuple[Float[np.ndarray, "frame 4 4"], str] | None:
    """Return ``world_from_camera`` of all frames (NaN: unknown) and its source; None if unplaced."""
    clip = Clip.open(folders.frames[video.id])
    if clicked is not None and clicked.trusted.any():
        placed = all_cameras(clicked, clip.odometry_from_camera, len(clip))
        return placed, f"clicked correspondences in {int(clicked.trusted.sum())} frames"
    if clip.odometry_from_camera is None:
        return None
    model = localizers.load(folders.scene_localizer, device)
    votes = []
    for frame in subsampling.evenly(len(clip), LOCALIZED).tolist():
        answers = model.localize(
            clip.color(frame), clip.depth(frame), clip.depth_intrinsics[frame], clip.intrinsics[frame]
        )
        if answers:
            votes.append(answers[0].map_from_camera @ rigid.inverse(clip.odometry_from_camera[frame]))
    agreed = agreement(np.array(votes).reshape(-1, 4, 4))
    if agreed is None:
        return None
    source = f"registration: {agreed[1]} of {len(votes)} single frames agree"
    return agreed[0] @ clip.odometry_from_camera, source


def agreement(votes: Float[np.ndarray, "vote 4 4"]) -> tuple[Float[np.ndarray, "4 4"], int] | None:
    """Return the mean of the largest group of votes that agree, and its size; None below four."""
    if len(votes) < MIN_VOTES:
        return None
    degrees = np.degrees(rigid.rotation_angle(votes[:, None, :3, :3], votes[None, :, :3, :3]))
    meters = np.linalg.norm(votes[:, None, :3, 3] - votes[None, :, :3, 3], axis=-1)
    near = (degrees < AGREE[0]) & (meters < AGREE[1])
    group = near[near.sum(1).argmax()]
    if group.sum() < MIN_VOTES:
        return None
    shift = np.median(votes[group][:, :3, 3], axis=0)
    return rigid.make(rigid.mean_rotation(votes[group][:, :3, :3]), shift), int(group.sum())


def shots(
    folders: BuildFolders, video: Video, world_from_camera: Float[np.ndarray, "frame 4 4"], count: int
) -> Sequence[HeldoutShot]:
    """Return what the phone measured during its session, in up to ``count`` frames of known camera."""
    clip, found = Clip.open(folders.frames[video.id]), []
    together = reading.filmed_together(folders, video)
    known = together[np.isfinite(world_from_camera[together]).all((1, 2))]
    for frame in subsampling.some(known, count).tolist():
        depth = usable_depth(clip, frame, farthest_m=RANGE_M)
        color = cv2.resize(clip.color(frame), depth.shape[::-1], interpolation=cv2.INTER_AREA)
        time_s = float(clip.timestamp_s[frame] + video.offset_s)
        camera = world_from_camera[frame], clip.depth_intrinsics[frame]
        found.append(HeldoutShot(*camera, time_s, color, depth, agent=np.zeros(depth.shape, bool)))
    return found
