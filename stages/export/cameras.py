"""Pictures with their cameras, for training radiance fields: nerfstudio's `transforms.json`, COLMAP's model.

Both copy recorded pictures: they are written only where asked for by name.
"""

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float

from pipeline.data import images
from pipeline.geometry import rigid
from pipeline.geometry.cameras import OPENCV_FROM_OPENGL
from pipeline.geometry.meshes import Mesh
from pipeline.geometry.subsampling import evenly
from stages.export.reading import CameraFrame
from stages.export.writing import ExportRecord, version

COLMAP_POINTS = 20_000
"""Points of the room in the COLMAP model: enough to start Gaussians from, a megabyte as text."""


def write_nerfstudio(folder: Path, frames: list[CameraFrame]) -> ExportRecord:
    """Write `transforms.json` (OpenGL camera-to-world), pictures, depth in millimeters, masks of the room."""
    for name in ("images", "depth", "masks"):
        (folder / name).mkdir()
    entries = []
    for frame in frames:
        height, width = _write_picture(folder, frame)
        _write_depth(folder / f"depth/{frame.name}.png", frame.depth, width, height)
        agent = frame.agent_mask
        mask = np.full((height, width), 255, np.uint8) if agent is None else 255 - agent
        images.write_gray(folder / f"masks/{frame.name}.png", mask)
        k = frame.intrinsics
        entries.append(
            {
                "file_path": f"images/{frame.name}.jpg",
                "depth_file_path": f"depth/{frame.name}.png",
                "mask_path": f"masks/{frame.name}.png",
                "transform_matrix": (frame.world_from_camera @ OPENCV_FROM_OPENGL).tolist(),
                "fl_x": k[0, 0], "fl_y": k[1, 1], "cx": k[0, 2], "cy": k[1, 2], "w": width, "h": height,
            }
        )  # fmt: skip
    table = {"camera_model": "OPENCV", "k1": 0, "k2": 0, "p1": 0, "p2": 0, "frames": entries}
    (folder / "transforms.json").write_text(json.dumps(table, indent=1) + "\n")
    depth = "depth PNG in millimeters, 0 = unknown, at the picture's size"
    remark = f"OpenGL cameras, meters, +y up; {depth}; masks are black on the animal"
    return ExportRecord("own writer", {}, "own reader", remark)


def write_colmap(folder: Path, frames: list[CameraFrame], room: Mesh) -> ExportRecord:
    """Write `images/`, `masks/` and `sparse/0/` (text model, world-to-camera), with points of the room."""
    for name in ("images", "masks", "sparse/0"):
        (folder / name).mkdir(parents=True)
    cameras, pictures = [], []
    for number, frame in enumerate(frames, start=1):
        height, width = _write_picture(folder, frame)
        agent = frame.agent_mask
        if agent is not None:
            images.write_gray(folder / f"masks/{frame.name}.jpg.png", 255 - agent)
        k = frame.intrinsics
        lens = f"{k[0, 0]:.9g} {k[1, 1]:.9g} {k[0, 2]:.9g} {k[1, 2]:.9g}"
        cameras.append(f"{number} PINHOLE {width} {height} {lens}")
        camera_from_world = rigid.inverse(frame.world_from_camera)
        pose = [*rigid.quaternion_from_rotation(camera_from_world[:3, :3]), *camera_from_world[:3, 3]]
        pictures += [f"{number} {' '.join(f'{value:.12g}' for value in pose)} {number} {frame.name}.jpg", ""]
    chosen = evenly(len(room.vertices), COLMAP_POINTS)
    color = np.full((len(room.vertices), 3), 128, np.uint8) if room.color is None else room.color
    cloud = [
        " ".join([str(number), *(f"{value:.6f}" for value in room.vertices[at]), *map(str, color[at]), "0"])
        for number, at in enumerate(chosen, start=1)
    ]
    for name, lines in {"cameras": cameras, "images": pictures, "points3D": cloud}.items():
        (folder / f"sparse/0/{name}.txt").write_text("\n".join([*lines, ""]))
    loss = {"camera_places": round(1000 * _opened(folder / "sparse/0", frames), 6)}
    remark = "COLMAP's masks are black where features are ignored"
    return ExportRecord("own writer", loss, version("pycolmap"), remark)


def _opened(model: Path, frames: list[CameraFrame]) -> float:
    """Open the model with COLMAP and return the largest error of camera positions, meters."""
    found = pycolmap.Reconstruction(str(model))
    places = {image.name: image.projection_center() for image in found.images.values()}
    assert len(places) == len(frames), (len(places), len(frames))
    apart = [places[f"{frame.name}.jpg"] - frame.world_from_camera[:3, 3] for frame in frames]
    return float(np.linalg.norm(apart, axis=1).max())


def _write_picture(folder: Path, frame: CameraFrame) -> tuple[int, int]:
    """Copy the stored picture; return its height and width."""
    data = frame.jpeg
    (folder / f"images/{frame.name}.jpg").write_bytes(data)
    height, width, _ = images.decode_color(data, frame.name).shape
    return height, width


def _write_depth(path: Path, depth: Float[np.ndarray, "height width"], width: int, height: int) -> None:
    enlarged = cv2.resize(depth.astype(np.float32), (width, height), interpolation=cv2.INTER_NEAREST)
    millimeters = np.clip(np.rint(np.where(np.isfinite(enlarged), enlarged, 0) * 1000), 0, 65535)
    path.write_bytes(cv2.imencode(".png", millimeters.astype(np.uint16))[1].tobytes())
