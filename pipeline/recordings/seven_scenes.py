"""7-Scenes style folders: `frame-%06d.color.png|jpg`, `.depth.png` (millimeters), `.pose.txt` or none.

The frame number counts at 30 Hz. Intrinsics from `camera-intrinsics.txt` or the set's default (depth camera).
The set's pictures are those of a separate color camera. Copies whose pictures were brought to the depth
camera's lens state the same intrinsics, so edges of pictures at depth steps decide.
"""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.geometry.subsampling import evenly
from pipeline.mapping.edge_agreement import edge_contrast, relative_gradient
from pipeline.mapping.picture_agreement import beats
from pipeline.recordings import errors, extraction, text_files
from pipeline.recordings.containers import FolderContainer
from pipeline.recordings.recording import (
    DepthCamera,
    Recording,
    intrinsics_from_coefficients,
    pose_from_matrix,
)

RATE_HZ = 30.0
KINECT_SIZE = (480, 640)
KINECT_DEPTH, KINECT_COLOR = (585.0, 585.0, 320.0, 240.0), (525.5, 525.5, 320.0, 240.0)
"""fx, fy, cx, cy of the data set's Kinects at 640 x 480, pixels: the depth camera's as documented, the color
camera's as estimated from matches between its pictures and depth edges
"""
KINECT_DEPTH_FROM_COLOR = np.array([[1, 0, 0, 0.025], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
"""the color camera is 2.5 cm to the right of the depth camera"""
SAME_LENS_PX = 0.5
"""tolerance for given intrinsics to count as those of the data set's depth camera, as often"""
FRAMES, FARTHEST_M = 24, 5.0
"""frames in which both readings of a Kinect's folder are compared, and the range of their depth"""
NAME = re.compile(r"frame-([0-9]{1,18})\.(color\.(?:png|jpg|jpeg)|depth\.png|pose\.txt)\Z")


def open_recording(path: Path) -> Recording:
    """Open a 7-Scenes style folder. Raises InputError CAP-001..011."""
    container = FolderContainer(path)
    files: dict[str, dict[int, str]] = {"color": {}, "depth": {}, "pose": {}}
    for name in sorted(container.names):
        match = NAME.match(name)
        if match:
            files[match[2].split(".")[0]][int(match[1])] = name
    if not files["depth"]:
        raise errors.no_depth(container.where, "there is no frame-*.depth.png")
    index = np.array(sorted(files["color"].keys() & files["depth"].keys()), int)
    if len(index) == 0:
        raise errors.no_frames(container.where, "no frame has color and depth")
    first = int(index[0])
    sizes = container.color(files["color"][first]).shape[:2], container.meters(files["depth"][first]).shape
    kinect = sizes == (KINECT_SIZE, KINECT_SIZE)
    intrinsics, remarks = text_files.read_intrinsics(container, len(index), KINECT_DEPTH if kinect else None)
    camera, camera_remarks = text_files.depth_camera(container, intrinsics[0], sizes)
    stored = Recording(
        where=container.where,
        kind="7-Scenes RGB-D",
        index=index,
        timestamp_s=(index - first) / RATE_HZ,
        intrinsics=intrinsics,
        pose=_poses(container, index, files["pose"], camera),
        color_size=sizes[0],
        depth_size=sizes[1],
        read_color=lambda i: container.read(files["color"][i]),
        read_depth=lambda i: container.meters(files["depth"][i], sizes[1]),
        depth_camera=camera,
        remarks=remarks + camera_remarks,
        listed=len(files["color"].keys() | files["depth"].keys()),
    )
    given = intrinsics[0, [0, 1, 0, 1], [0, 1, 2, 2]]
    if camera is not None or not kinect or np.abs(given - KINECT_DEPTH).max() >= SAME_LENS_PX:
        return stored
    camera = DepthCamera(intrinsics[0], KINECT_DEPTH_FROM_COLOR)
    lens = intrinsics_from_coefficients(np.tile(KINECT_COLOR, (len(index), 1)), container.where)
    raw = replace(
        stored,
        intrinsics=lens,
        pose=_poses(container, index, files["pose"], camera),
        depth_camera=camera,
        remarks=(*remarks, text_files.depth_camera_remark(camera, lens[0])),
    )
    contrasts = []
    for number in index[evenly(len(index), FRAMES, rounded=True)].tolist():
        color = container.color(files["color"][number])
        gradient = relative_gradient(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY))
        depths = [extraction.stored_depth(each, number, FARTHEST_M) for each in (stored, raw)]
        contrasts.append([edge_contrast(gradient, depth) for depth in depths])
    as_stored, as_raw = np.array(contrasts).T
    return stored if beats(as_stored, as_raw, tests=1) else raw


def _poses(
    container: FolderContainer, index: np.ndarray, names: dict[int, str], camera: DepthCamera | None
) -> Float[np.ndarray, "frame 7"] | None:
    """Return the color camera's poses (the data set has the depth camera's), NaN where lost."""
    if not names:
        return None
    matrices = np.full((len(index), 4, 4), np.nan)
    for row, number in enumerate(index):
        if int(number) in names:
            matrices[row] = text_files.table(container, names[int(number)], 4, rows=4)
    return pose_from_matrix(matrices if camera is None else matrices @ camera.depth_from_color)
