"""Polycam raw data (LiDAR or room mode, developer mode): sparse keyframes with poses, for the walk-through.

Optimized pictures and cameras (`corrected_*`) are used where both exist; depth is dropped in
their black borders. The app's own mesh, `raw.glb`, is rotated to its own axes; the inverse of
`alignmentTransform` (column-major) maps it back to the cameras' world.
"""

import io
import json
import struct
from pathlib import Path

import cv2
import numpy as np
import trimesh
from jaxtyping import Float, UInt8

from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh
from pipeline.recordings import errors
from pipeline.recordings.containers import FolderContainer
from pipeline.recordings.conventions import OPENGL
from pipeline.recordings.recording import Y_UP, Recording, intrinsics_from_coefficients, pose_from_matrix

TRUSTED_M = 5.0
"""maximum trusted depth, meters"""
MAX_MESH_BYTES = 512 << 20
GLB_JSON_LENGTH_AT, GLB_JSON_AT = 12, 20  # byte offsets of length and content of a GLB's JSON chunk
COEFFICIENTS = ("fx", "fy", "cx", "cy")
MATRIX = tuple(f"t_{row}{column}" for row in range(3) for column in range(4))


def open_recording(path: Path) -> Recording:
    """Open a Polycam raw data folder. Raises InputError CAP-001..008."""
    container = FolderContainer(path)
    corrected = {"corrected_images", "corrected_cameras"} <= {
        name.split("/")[1] for name in container.names if name.startswith("keyframes/")
    }
    color, camera = ("corrected_images", "corrected_cameras") if corrected else ("images", "cameras")
    files = [container.numbered(f"keyframes/{part}") for part in (color, camera, "depth")]
    if not files[2]:
        raise errors.no_depth(container.where, "keyframes/depth is empty: record in LiDAR or room mode")
    index = np.array(sorted(set.intersection(*map(set, files))), int)
    if len(index) == 0:
        raise errors.no_frames(container.where, "no keyframe has picture, camera and depth")
    tables = [_camera(container, f"keyframes/{camera}/{number}.json") for number in index]
    sizes = {(int(table["height"]), int(table["width"])) for table in tables}
    if len(sizes) != 1:
        raise errors.broken_metadata(container.where, f"keyframes of {len(sizes)} sizes")
    size = _depth(container, int(index[0]), None).shape
    matrices = _columns(tables, MATRIX).reshape(-1, 3, 4)
    confidence = container.numbered("keyframes/confidence")
    mesh = {"raw.glb", "mesh_info.json"} <= container.names

    def depth(number: int) -> np.ndarray:
        measured = _depth(container, number, size)
        if not corrected:
            return measured
        brightest = container.color(f"keyframes/{color}/{number}.jpg").max(-1)
        return np.where(cv2.resize(brightest, size[::-1], interpolation=cv2.INTER_AREA) < 3, 0, measured)

    return Recording(
        where=container.where,
        kind="Polycam raw data",
        index=index,
        timestamp_s=(index - index[0]) * 1e-6,
        intrinsics=intrinsics_from_coefficients(_columns(tables, COEFFICIENTS), container.where),
        pose=pose_from_matrix(rigid.make(matrices[..., :3], matrices[..., 3])),
        color_size=next(iter(sizes)),
        depth_size=size,
        read_color=lambda i: container.read(f"keyframes/{color}/{i}.jpg"),
        read_depth=depth,
        read_confidence=(lambda i: _confidence(container, confidence.get(i), size)) if confidence else None,
        convention=OPENGL,
        up=Y_UP,
        read_mesh=(lambda: _mesh(container)) if mesh else None,
        remarks=("Polycam keeps sparse keyframes: good for the walk-through, too few for the animal",),
        listed=len(set.union(*map(set, files))),
    )


def _camera(container: FolderContainer, name: str) -> dict[str, float]:
    try:
        table = container.table(name)
        camera = {key: float(table[key]) for key in (*COEFFICIENTS, *MATRIX)}
        return camera | {key: int(table[key]) for key in ("width", "height")}
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise errors.broken_metadata(container.place(name), f"not a camera ({error!r})") from error


def _columns(tables: list[dict[str, float]], keys: tuple[str, ...]) -> Float[np.ndarray, "frame column"]:
    return np.array([[table[key] for key in keys] for table in tables])


def _depth(
    container: FolderContainer, number: int, size: tuple[int, int] | None
) -> Float[np.ndarray, "height width"]:
    depth = container.meters(f"keyframes/depth/{number}.png", size)
    return np.where(depth <= TRUSTED_M, depth, np.float32(0))


def _mesh(container: FolderContainer) -> Mesh:
    """Read the app's mesh into the cameras' world. Raises CAP-001 and CAP-004."""
    table = container.table("mesh_info.json")
    try:
        aligned_from_world = np.array(table["alignmentTransform"], float).reshape(4, 4).T
        world_from_aligned = np.linalg.inv(aligned_from_world)
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        where = container.place("mesh_info.json")
        raise errors.broken_metadata(where, f"no alignmentTransform of 16 numbers ({error!r})") from error
    try:
        data = container.read("raw.glb", MAX_MESH_BYTES)
        listed = json.loads(data[GLB_JSON_AT:][: struct.unpack_from("<I", data, GLB_JSON_LENGTH_AT)[0]])
        assert sum(each["count"] for each in listed["accessors"]) <= len(data), "more values than bytes"
        loaded = trimesh.load(io.BytesIO(data), file_type="glb", force="mesh")
    except Exception as error:  # readers raise anything for a truncated file
        raise errors.damaged(container.place("raw.glb"), repr(error)) from error
    if not isinstance(loaded, trimesh.Trimesh) or not len(loaded.faces):
        raise errors.damaged(container.place("raw.glb"), "it holds no surface")
    vertices = rigid.apply(world_from_aligned, np.asarray(loaded.vertices, float)).astype(np.float32)
    return Mesh(vertices, np.asarray(loaded.faces, np.int32), np.full((len(vertices), 3), 128, np.uint8))


def _confidence(
    container: FolderContainer, name: str | None, size: tuple[int, int]
) -> UInt8[np.ndarray, "height width"] | None:
    """Read confidence as 0 low, 1 medium, 2 high; stored values are 0 low, 255 high, and others medium."""
    if name is None:
        return None
    raw = container.gray(name)
    if raw.shape != size:
        raw = cv2.resize(raw, size[::-1], interpolation=cv2.INTER_NEAREST)
    return np.where(raw == 0, 0, np.where(raw == 255, 2, 1)).astype(np.uint8)
