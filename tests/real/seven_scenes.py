"""Fifty frames of a real kitchen (7-Scenes): a walk-through and a session, without odometry."""

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from jaxtyping import Float

from pipeline.data import images, npz
from pipeline.data.clips import Clip

REAL = Path(os.environ.get("ATS_REALDATA", Path(__file__).parents[3] / "shared" / "realdata"))
SCENE = REAL / "7scenes_AB50"
RATE_HZ = 30.0


@dataclass(frozen=True)
class Half:
    """One half as a recording, and its true cameras."""

    clip: Clip
    world_from_camera: Float[np.ndarray, "frame 4 4"]


def halves(folder: Path) -> tuple[Half, Half]:
    """Write both halves as frames; skip where the sample is absent."""
    if not SCENE.exists():
        pytest.skip(f"no real kitchen at {SCENE} (set ATS_REALDATA)")
    numbers = sorted(int(path.name[6:12]) for path in SCENE.glob("*.pose.txt"))
    return tuple(_half(folder / name, chosen) for name, chosen in (("a", numbers[:25]), ("b", numbers[25:])))


def _half(folder, numbers):
    for name in ("color", "depth", "confidence"):
        (folder / name).mkdir(parents=True)
    for index, number in enumerate(numbers):
        shutil.copy(SCENE / f"frame-{number:06d}.color.jpg", folder / "color" / f"{index:06d}.jpg")
        depth = cv2.imread(str(SCENE / f"frame-{number:06d}.depth.png"), cv2.IMREAD_UNCHANGED) / np.float32(
            1000
        )
        images.write_depth(
            folder / "depth" / f"{index:06d}.exr", np.where(depth < 10, depth, 0).astype(np.float32)
        )
        images.write_gray(folder / "confidence" / f"{index:06d}.png", np.full(depth.shape, 2, np.uint8))
    intrinsics = np.repeat(np.loadtxt(SCENE / "camera-intrinsics.txt")[None], len(numbers), axis=0)
    npz.save(
        folder / "frames.npz",
        timestamp_s=(np.array(numbers) - numbers[0]) / RATE_HZ,
        intrinsics=intrinsics,
        depth_intrinsics=intrinsics,
        gravity_known=np.array(False),
        quality=np.ones(len(numbers), np.float32),
    )
    truth = np.stack([np.loadtxt(SCENE / f"frame-{number:06d}.pose.txt") for number in numbers])
    return Half(Clip.open(folder), truth)
