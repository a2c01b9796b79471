"""Write Record3D's "Shareable/Internal" container (`.r3d`), byte for byte the same for the same frames.

A zip with `metadata` (JSON), `rgbd/<i>.jpg`, `rgbd/<i>.depth` and `rgbd/<i>.conf` (LZFSE). Poses are
camera-to-world with OpenGL axes, quaternion x y z w then translation; K is column-major.
"""

import json
import zipfile
from pathlib import Path

import cv2
import lzfse
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.geometry import cameras, rigid
from stages.synthesize_capture.script import Script

_ZIP_TIME = (2024, 6, 1, 12, 0, 0)


def metadata(script: Script) -> dict:
    """Return the JSON of apps of 2024 and later."""
    phone, world_from_camera = script.phone, cameras.opencv_from_opengl(script.odometry_from_camera)
    quaternion = np.roll(rigid.quaternion_from_rotation(world_from_camera[:, :3, :3]), -1, axis=-1)
    fx, fy, cx, cy = script.intrinsics[0]
    return {
        "w": phone.color_size[1],
        "h": phone.color_size[0],
        "dw": phone.depth_size[1],
        "dh": phone.depth_size[0],
        "fps": round(phone.fps),
        "K": [round(float(value), 6) for value in (fx, 0, 0, 0, fy, 0, cx, cy, 1)],
        "poses": np.concatenate([quaternion, world_from_camera[:, :3, 3]], axis=-1).round(8).tolist(),
        "frameTimestamps": script.timestamp_s.round(6).tolist(),
        "initPose": [0, 0, 0, 1, 0, 0, 0],
        "cameraType": 1,
        "perFrameIntrinsicCoeffs": script.intrinsics.round(5).tolist(),
    }


class Writer:
    """Adds frames one by one to a recording; use it as a context manager."""

    def __init__(self, path: Path):
        self._zip = zipfile.ZipFile(path, "w", zipfile.ZIP_STORED)
        self._count = 0

    def __enter__(self) -> "Writer":
        return self

    def __exit__(self, *error) -> None:
        self._zip.close()

    def add(
        self,
        color: UInt8[np.ndarray, "height width 3"],
        depth: Float[np.ndarray, "rows columns"],
        confidence: UInt8[np.ndarray, "rows columns"],
    ) -> None:
        """Append one frame: RGB, depth in meters (float32), confidence 0 to 2."""
        bgr, quality = cv2.cvtColor(color, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 92]
        done, jpeg = cv2.imencode(".jpg", bgr, quality)
        assert done, "JPEG encoding failed"
        name = f"rgbd/{self._count}"
        self._member(f"{name}.jpg", jpeg.tobytes())
        self._member(f"{name}.depth", lzfse.compress(np.ascontiguousarray(depth, "<f4").tobytes()))
        self._member(f"{name}.conf", lzfse.compress(np.ascontiguousarray(confidence, np.uint8).tobytes()))
        if self._count == 0:
            self._member("icon", jpeg.tobytes())
        self._count += 1

    def finish(self, script: Script) -> None:
        """Write the metadata, after the frames."""
        times = len(script.timestamp_s)
        assert times == self._count, f"{self._count} frames, {times} timestamps"
        self._member("metadata", json.dumps(metadata(script)).encode())

    def _member(self, name: str, data: bytes) -> None:
        member = zipfile.ZipInfo(name, _ZIP_TIME)
        member.external_attr = 0o644 << 16
        self._zip.writestr(member, data)
