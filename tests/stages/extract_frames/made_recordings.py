"""Small recordings with ground truth: a phone moves through a box-shaped room, in the format of Record3D."""

import io
import json
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import lzfse
import numpy as np

from pipeline.data import images
from pipeline.geometry import cameras, rigid

ROOM = np.array([4.0, 2.5, 5.0])
COLOR_SIZE, DEPTH_SIZE = (64, 48), (32, 24)


@dataclass
class Made:
    """A recording to write; tests modify its fields and call `write`."""

    world_from_camera: np.ndarray
    """[frame 4 4] OpenCV axes of the stored picture"""
    timestamp_s: np.ndarray
    metadata: dict = field(default_factory=dict)
    """overrides; None removes a key"""
    members: dict = field(default_factory=dict)
    """overrides of whole members; None removes one"""
    quarter_turns: int = 0
    """clockwise turns from upright to stored"""

    @property
    def intrinsics(self) -> np.ndarray:
        """Intrinsics of the stored color pictures."""
        upright = np.array([[50.0, 0, 25], [0, 52, 31], [0, 0, 1]])
        return cameras.turn_intrinsics(upright, COLOR_SIZE, self.quarter_turns)

    def depth(self, frame: int) -> np.ndarray:
        """Stored z-depth, meters: distance to the nearest wall along each ray."""
        size, color_size = self._size(DEPTH_SIZE), self._size(COLOR_SIZE)
        rays = cameras.ray_directions(cameras.scale_intrinsics(self.intrinsics, color_size, size), *size)
        return self._wall_m(rays, self.stored_from_upright(self.world_from_camera[frame])).astype("<f4")

    def _wall_m(self, rays: np.ndarray, world_from_camera: np.ndarray) -> np.ndarray:
        direction, origin = rays @ world_from_camera[:3, :3].T, world_from_camera[:3, 3]
        with np.errstate(divide="ignore"):
            return np.where(direction > 0, (ROOM - origin) / direction, -origin / direction).min(-1)

    def stored_from_upright(self, world_from_camera: np.ndarray) -> np.ndarray:
        """Camera pose of the stored picture."""
        return cameras.turn_camera(world_from_camera, self.quarter_turns)

    def color(self, frame: int) -> np.ndarray:
        """Stored picture: brightness increases to the right of the upright picture and with time."""
        ramp = np.linspace(40, 200, COLOR_SIZE[1]).astype(np.uint8)
        picture = np.broadcast_to(ramp[None, :, None], (*COLOR_SIZE, 3)) + np.uint8(frame % 40)
        return cameras.turn_image(picture, self.quarter_turns)

    def poses(self) -> np.ndarray:
        """[frame 7] as stored by the app: OpenGL axes, quaternion xyzw, meters."""
        stored = cameras.opencv_from_opengl(self.stored_from_upright(self.world_from_camera))
        wxyz = rigid.quaternion_from_rotation(stored[:, :3, :3])
        return np.concatenate([np.roll(wxyz, -1, axis=1), stored[:, :3, 3]], axis=1)

    def table(self) -> dict:
        """The metadata with the overrides."""
        (height, width), (depth_height, depth_width) = self._size(COLOR_SIZE), self._size(DEPTH_SIZE)
        table = dict(w=width, h=height, dw=depth_width, dh=depth_height, fps=60, cameraType=1)
        table |= dict(K=self.intrinsics.T.ravel().tolist(), poses=self.poses().tolist())
        table |= (
            dict(frameTimestamps=self.timestamp_s.tolist(), initPose=[0, 0, 0, 1, 0, 0, 0]) | self.metadata
        )
        return {key: value for key, value in table.items() if value is not None}

    def write(self, path: Path) -> Path:
        """Write a ``.r3d``."""
        members = {"metadata": json.dumps(self.table()).encode()}
        for frame in range(len(self.timestamp_s)):
            depth = self.depth(frame)
            members[f"rgbd/{frame}.jpg"] = images.encode_jpeg(self.color(frame))
            members[f"rgbd/{frame}.depth"] = lzfse.compress(depth.tobytes())
            members[f"rgbd/{frame}.conf"] = lzfse.compress(np.full(depth.shape, 1, np.uint8).tobytes())
        write_zip(path, members | self.members)
        return path

    def _size(self, upright: tuple[int, int]) -> tuple[int, int]:
        return upright[::-1] if self.quarter_turns % 2 else upright


def write_zip(path: Path, members: dict[str, bytes | None]) -> None:
    """Write members in order; None omits one."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            if data is not None:
                archive.writestr(name, data)
    path.write_bytes(buffer.getvalue())


def walk(frames: int = 24, rate_hz: float = 15.0, quarter_turns: int = 0) -> Made:
    """A phone that walks and turns through the room, looking slightly down, y up."""
    timestamp_s = np.arange(frames) / rate_hz
    angle = 0.3 + 0.5 * timestamp_s
    eye = np.stack([1.5 + 0.3 * timestamp_s, 1.3 + 0.1 * np.sin(3 * timestamp_s), 1.5 + 0.2 * timestamp_s], 1)
    target = eye + np.stack([np.sin(angle), -0.4 + 0.1 * np.sin(timestamp_s), np.cos(angle)], 1)
    up = np.array([0.0, 1.0, 0.0])
    world_from_camera = np.stack([rigid.look_at(*pair, up) for pair in zip(eye, target, strict=True)])
    return Made(world_from_camera, timestamp_s, quarter_turns=quarter_turns)
