"""A video: alone, or in a folder with `intrinsics.txt` and `depth/`, a picture per frame, named by number.

Depth: 16-bit PNG in millimeters or EXR in meters, aligned with the picture as stored. `poses.txt`, if any:
frame number, tx ty tz qx qy qz qw of the camera (OpenCV axes) in its world. A video alone has no scale.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.core.videos import VIDEO_SUFFIXES
from pipeline.data import images
from pipeline.recordings import errors, text_files
from pipeline.recordings.containers import FolderContainer
from pipeline.recordings.movies import Movie
from pipeline.recordings.recording import Recording

MIN_NUMBERED = 0.6
"""least share of the video that depth reaches; less may be its own count at half the video's rate"""


def open_recording(path: Path) -> Recording:
    """Open a video file, or a folder with one video and its depth. Raises InputError CAP-001..011."""
    if path.is_file():
        return _alone(path)
    container = FolderContainer(path)
    movies = sorted(
        name for name in container.names if Path(name).suffix.lower() in VIDEO_SUFFIXES and "/" not in name
    )
    if odometry := [name for name in container.names if name.lower() == "odometry.csv"]:
        files = "rgb.mp4, odometry.csv, camera_matrix.csv and depth/"
        why = f"{odometry[0]} is Stray Scanner's, whose files are named {files}, in lower case"
        raise errors.broken_metadata(container.where, why)
    if len(movies) != 1:
        raise errors.broken_metadata(container.where, f"{len(movies)} videos in the folder instead of one")
    movie = Movie(path / movies[0])
    depth = container.numbered("depth", ".png", ".exr")
    if not depth:
        raise errors.no_depth(container.where, "depth/ holds no numbered PNG or EXR pictures")
    index = np.array(sorted(depth.keys() & set(movie.complete.tolist())), int)
    if len(index) == 0:
        raise errors.no_frames(container.where, "no depth picture has a video frame's number, from 0")
    errors.refuse_numbers_from_1(depth, len(movie), "depth/", container.where)
    if max(depth) + 1 < MIN_NUMBERED * len(movie):
        why = f"{len(movie)} video frames, but depth up to number {max(depth)}: name it by the frame"
        raise errors.broken_metadata(container.where, why)
    size = _depth(container, depth[int(index[0])], None).shape
    intrinsics, remarks = text_files.read_intrinsics(container, len(index), default=None)
    camera, camera_remarks = text_files.depth_camera(container, intrinsics[0], (movie.size, size))
    return Recording(
        where=container.where,
        kind="video and depth",
        index=index,
        timestamp_s=movie.timestamp_s[index] - movie.timestamp_s[index[0]],
        intrinsics=intrinsics,
        pose=_poses(container, index, len(movie)),
        color_size=movie.size,
        depth_size=size,
        read_color=movie.read,
        read_depth=lambda i: _depth(container, depth[i], size),
        quarter_turns=movie.quarter_turns,
        depth_camera=camera,
        remarks=remarks + camera_remarks + movie.remarks,
        listed=-(-len(movie) // max(1, int(np.median(np.diff(sorted(depth)))))) if len(depth) > 1 else 0,
    )


def _alone(path: Path) -> Recording:
    movie = Movie(path, square_pixels=True)
    return Recording(
        where=str(path),
        kind="video without depth",
        index=movie.complete,
        timestamp_s=movie.timestamp_s[movie.complete],
        intrinsics=None,
        pose=None,
        color_size=movie.size,
        depth_size=None,
        read_color=movie.read,
        read_depth=lambda i: np.zeros((0, 0), np.float32),
        quarter_turns=movie.quarter_turns,
        remarks=movie.remarks,
        listed=len(movie),
    )


def _depth(
    container: FolderContainer, name: str, size: tuple[int, int] | None
) -> Float[np.ndarray, "height width"]:
    if name.lower().endswith(".png"):
        return container.meters(name, size)
    depth = images.read_depth(container.path(name), channel=None)
    errors.refuse_other_size(depth.shape, size, container.place(name))
    return depth


def _poses(container: FolderContainer, index: np.ndarray, frames: int) -> Float[np.ndarray, "frame 7"] | None:
    if "poses.txt" not in container.names:
        return None
    table = text_files.table(container, "poses.txt", 8)
    pose = {row[0]: row[[4, 5, 6, 7, 1, 2, 3]] for row in table if np.isfinite(row[0])}
    if any(number % 1 for number in pose):
        raise errors.broken_metadata(container.place("poses.txt"), "column 1 must be the frame's number")
    errors.refuse_numbers_from_1(pose, frames, "poses.txt", container.where)
    return np.array([pose.get(number, np.full(7, np.nan)) for number in index.tolist()])
