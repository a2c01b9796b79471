"""Pictures with their cameras, for training radiance fields elsewhere: nerfstudio's `transforms.json` and COLMAP's model.

Both copy recorded pictures: they are written only where asked for by name.
"""

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float

from pipeline.files import images
from pipeline.space import rigid
from pipeline.space.meshes import Mesh
from stages.export.reading import Shot
from stages.export.writing import Told, version

_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def write_nerfstudio(folder: Path, shots: list[Shot], room: Mesh, points: int) -> Told:
    """Write `transforms.json` (OpenGL camera-to-world), pictures, depth in millimetres (0 = unknown), masks without the animal."""
    for name in ("images", "depth", "masks"):
        (folder / name).mkdir()
    frames = []
    for shot in shots:
        height, width = _write_picture(folder, shot)
        _write_depth(folder / f"depth/{shot.name}.png", shot.depth, width, height)
        agent = shot.agent_mask
        images.write_gray(folder / f"masks/{shot.name}.png", np.full((height, width), 255, np.uint8) if agent is None else 255 - agent)
        k = shot.intrinsics
        frames.append(
            {
                "file_path": f"images/{shot.name}.jpg",
                "depth_file_path": f"depth/{shot.name}.png",
                "mask_path": f"masks/{shot.name}.png",
                "transform_matrix": (shot.world_from_camera @ _OPENGL_FROM_OPENCV).tolist(),
                "fl_x": k[0, 0], "fl_y": k[1, 1], "cx": k[0, 2], "cy": k[1, 2], "w": width, "h": height,
            }
        )  # fmt: skip
    table = {"camera_model": "OPENCV", "k1": 0, "k2": 0, "p1": 0, "p2": 0, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(table, indent=1) + "\n")
    for frame in json.loads((folder / "transforms.json").read_bytes())["frames"]:
        assert (folder / frame["file_path"]).exists() and (folder / frame["depth_file_path"]).exists()
    remark = "OpenGL cameras, metres, +y up; depth PNG in millimetres, 0 = unknown, at the picture's size; masks are black on the animal"
    return Told("own writer", {}, "own reader", remark)


def write_colmap(folder: Path, shots: list[Shot], room: Mesh, points: int) -> Told:
    """Write `images/`, `masks/` and `sparse/0/` (text model, world-to-camera), with points of the room's surface."""
    for name in ("images", "masks", "sparse/0"):
        (folder / name).mkdir(parents=True)
    cameras, pictures = [], []
    for number, shot in enumerate(shots, start=1):
        height, width = _write_picture(folder, shot)
        agent = shot.agent_mask
        if agent is not None:
            images.write_gray(folder / f"masks/{shot.name}.jpg.png", 255 - agent)
        k = shot.intrinsics
        cameras.append(f"{number} PINHOLE {width} {height} {k[0, 0]:.9g} {k[1, 1]:.9g} {k[0, 2]:.9g} {k[1, 2]:.9g}")
        camera_from_world = rigid.inverse(shot.world_from_camera)
        pose = [*rigid.quaternion_from_rotation(camera_from_world[:3, :3]), *camera_from_world[:3, 3]]
        pictures += [f"{number} {' '.join(f'{value:.12g}' for value in pose)} {number} {shot.name}.jpg", ""]
    chosen = np.unique(np.linspace(0, len(room.vertices) - 1, min(points, len(room.vertices))).astype(int))
    color = np.full((len(room.vertices), 3), 128, np.uint8) if room.color is None else room.color
    cloud = [
        f"{number} {' '.join(f'{value:.6f}' for value in room.vertices[at])} {' '.join(map(str, color[at]))} 0"
        for number, at in enumerate(chosen, start=1)
    ]
    for name, lines in {"cameras": cameras, "images": pictures, "points3D": cloud}.items():
        (folder / f"sparse/0/{name}.txt").write_text("\n".join([*lines, ""]))
    loss_mm = 1000 * _opened(folder / "sparse/0", shots)
    return Told(
        "own writer", {"camera_places": round(loss_mm, 6)}, version("pycolmap"), "COLMAP's masks are black where features are ignored"
    )


def _opened(model: Path, shots: list[Shot]) -> float:
    """Open the model with COLMAP and return how far cameras are from where they belong, metres."""
    found = pycolmap.Reconstruction(str(model))
    places = {image.name: image.projection_center() for image in found.images.values()}
    assert len(places) == len(shots), (len(places), len(shots))
    return max(float(np.linalg.norm(places[f"{shot.name}.jpg"] - shot.world_from_camera[:3, 3])) for shot in shots)


def _write_picture(folder: Path, shot: Shot) -> tuple[int, int]:
    """Copy the stored picture; return its height and width."""
    data = shot.jpeg
    (folder / f"images/{shot.name}.jpg").write_bytes(data)
    height, width, _ = images.decode_color(data, shot.name).shape
    return height, width


def _write_depth(path: Path, depth: Float[np.ndarray, "height width"], width: int, height: int) -> None:
    enlarged = cv2.resize(depth.astype(np.float32), (width, height), interpolation=cv2.INTER_NEAREST)
    millimetres = np.clip(np.rint(np.where(np.isfinite(enlarged), enlarged, 0) * 1000), 0, 65535).astype(np.uint16)
    path.write_bytes(cv2.imencode(".png", millimetres)[1].tobytes())
