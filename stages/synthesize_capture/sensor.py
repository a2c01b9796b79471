"""Sensor model of the phone: timestamps, intrinsics, picture, LiDAR depth, drifting odometry.

Each function turns truth into what a Record3D phone would store; none of them knows about files.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.ndimage import gaussian_filter1d

from pipeline.geometry import rigid
from stages.synthesize_capture.light import Hour

DEPTH_REACH_M = 5.0
_TONE = (np.clip(1.06 * (1 - np.exp(-1.9 * np.linspace(0, 2.5, 4096))), 0, 1) ** (1 / 2.2) * 255).astype(
    np.float32
)


@dataclass(frozen=True)
class Exposure:
    """How a recording is exposed: gain and its slow wander, white balance, noise at unit signal."""

    gain: float
    gain_wander: float
    white_balance: Float[np.ndarray, "3"]
    noise: float
    shutter_s: float


def exposure_of_recording(rng: np.random.Generator, hour: Hour) -> Exposure:
    """Draw an exposure; the evening stays darker, noisier and more blurred."""
    balance = 1.0 + rng.uniform(-0.07, 0.07, 3)
    balance[1] = 1.0
    if hour == "evening":
        return Exposure(rng.uniform(0.95, 1.15), 0.06, balance, 0.03, 1 / 45)
    return Exposure(rng.uniform(0.85, 1.12), 0.10, balance, 0.012, 1 / 110)


def timestamps(rng: np.random.Generator, duration_s: float, fps: float) -> Float[np.ndarray, "frame"]:
    """Return recorded times from 0: nominal rate, a millisecond of jitter, now and then lost frames."""
    times = np.arange(int(duration_s * fps + 1e-6) + 1) / fps
    times[1:] += np.clip(rng.normal(0, 0.0012, len(times) - 1), -0.004, 0.004)
    keep = np.ones(len(times), bool)
    for start in np.flatnonzero(rng.random(len(times)) < 0.006):
        keep[max(start, 1) : start + int(rng.integers(1, 4))] = False
    keep[0] = keep[-1] = True
    return times[keep]


def lens(
    rng: np.random.Generator, timestamp_s: Float[np.ndarray, "frame"], width: int, height: int
) -> Float[np.ndarray, "frame 4"]:
    """Return fx, fy, cx, cy per frame: about 54 by 68 degrees, with a stabilizer and a focus that wander."""
    focal = 235.0 / 240.0 * width * rng.uniform(0.985, 1.015)
    center = np.array([width, height]) / 2 + rng.normal(0, 0.004 * width, 2)
    wander = [_slow(rng, timestamp_s, 1.2) for _ in range(3)]
    fx = focal * (1 + 0.0012 * wander[0])
    cx, cy = (center[axis] + 0.0022 * width * wander[1 + axis] for axis in range(2))
    return np.stack([fx, fx, cx, cy], axis=-1)


def odometry(
    rng: np.random.Generator,
    timestamp_s: Float[np.ndarray, "frame"],
    world_from_camera: Float[np.ndarray, "frame 4 4"],
) -> Float[np.ndarray, "frame 4 4"]:
    """Return the phone's own poses: gravity-aligned, a new origin and heading, drifting.

    Steps between frames are chained with a slowly wrong heading (about a degree a minute), half a percent
    of scale and a small tilt.
    """
    count = len(timestamp_s)
    start = rigid.rotation_from_vector(np.array([0.0, rng.uniform(0, 2 * np.pi), 0.0]))
    rate = np.deg2rad(rng.normal(0, 1.0) + 0.7 * _slow(rng, timestamp_s, 15.0)) / 60
    heading = np.concatenate([[0.0], np.cumsum(rate[1:] * np.diff(timestamp_s))])
    tilt = np.deg2rad(0.1) * np.stack([_slow(rng, timestamp_s, 8.0) for _ in range(2)], axis=-1)
    vector = np.stack([tilt[:, 0], heading, tilt[:, 1]], axis=-1)
    turn = start @ rigid.rotation_from_vector(vector)
    scale = 1 + rng.normal(0, 0.004)
    position = world_from_camera[:, :3, 3]
    step = np.diff(position, axis=0)
    astray = np.stack([_slow(rng, timestamp_s, 2.0)[1:] for _ in range(3)], axis=-1)
    moved = scale * np.einsum("fij,fj->fi", turn[1:], step)
    moved = moved + 0.004 * np.linalg.norm(step, axis=-1, keepdims=True) * astray
    track = np.concatenate([np.zeros((1, 3)), np.cumsum(moved, axis=0)]) + rng.normal(0, 0.02, 3)
    jitter = rigid.rotation_from_vector(rng.normal(0, np.deg2rad(0.03), (count, 3)))
    return rigid.make(turn @ world_from_camera[:, :3, :3] @ jitter, track + rng.normal(0, 0.0006, (count, 3)))


def picture(
    linear: Float[np.ndarray, "height width 3"],
    exposure: Exposure,
    gain: float,
    blur_px: Float[np.ndarray, "2"],
    rng: np.random.Generator,
) -> UInt8[np.ndarray, "height width 3"]:
    """Expose linear light: motion blur along ``blur_px``, vignette, photon and read noise, tone curve."""
    image = _smeared(linear, blur_px)
    height, width, _ = image.shape
    gains = (exposure.gain * gain * exposure.white_balance).astype(np.float32)
    y, x = np.linspace(-1, 1, height)[:, None], np.linspace(-width / height, width / height, width)[None]
    vignette = (1 - 0.14 * (x * x + y * y)).astype(np.float32)
    image = image * gains * vignette[..., None]
    noise = rng.standard_normal(image.shape, dtype=np.float32)
    image += exposure.noise * np.sqrt(0.02 + image) * noise
    return _TONE[np.clip(image * (4095 / 2.5), 0, 4095).astype(np.uint16)].astype(np.uint8)


def lidar(
    depth: Float[np.ndarray, "height width"], rng: np.random.Generator
) -> tuple[Float[np.ndarray, "height width"], UInt8[np.ndarray, "height width"]]:
    """Return LiDAR-like depth (meters, float32; 0 or NaN unknown) and confidence 0 low, 1 medium, 2 high.

    Range noise of half a percent plus 4 mm with a spatial grain, outlines that wander by a pixel and smear
    into mixed pixels, holes along some edges, nothing past 5 m.
    """
    height, width = depth.shape
    bend = rng.standard_normal((height // 6 + 1, width // 6 + 1, 2), dtype=np.float32)
    bend = cv2.resize(bend, (width, height), interpolation=cv2.INTER_LINEAR)
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    x, y = x + 0.7 * bend[..., 0], y + 0.7 * bend[..., 1]
    seen = cv2.remap(depth, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    mixed = cv2.blur(seen, (3, 3))
    jump = cv2.morphologyEx(seen, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
    edge = jump > 0.05 + 0.03 * seen
    seen = np.where(edge & (bend[..., 0] > 0.1), mixed, seen)
    grain = cv2.GaussianBlur(rng.standard_normal((height, width), dtype=np.float32), (0, 0), 1.6) * 5.6
    noise = 0.8 * grain + 0.3 * rng.standard_normal((height, width), dtype=np.float32)
    measured = seen + (0.005 * seen + 0.004) * noise.astype(np.float32)
    slope = jump / np.maximum(seen, 0.3)
    confidence = np.where(slope > 0.09, 0, np.where((slope > 0.035) | (seen > 3.8), 1, 2)).astype(np.uint8)
    confidence = cv2.erode(confidence, np.ones((3, 3), np.uint8))
    measured = measured.astype(np.float16).astype(np.float32)
    measured[edge & (bend[..., 1] > 0.9)] = 0.0
    lost = (seen > DEPTH_REACH_M) | (seen <= 0.12)
    measured[lost] = np.nan
    confidence[lost | ~(measured > 0)] = 0
    return measured, confidence


def motion_blur_px(
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    timestamp_s: Float[np.ndarray, "frame"],
    focal_px: float,
    shutter_s: float,
) -> Float[np.ndarray, "frame 2"]:
    """Return how far (x, y) the turning camera moves the picture's center while the shutter is open."""
    turn = rigid.vector_from_rotation(
        np.swapaxes(world_from_camera[:-1, :3, :3], -1, -2) @ world_from_camera[1:, :3, :3]
    )
    rate = turn / np.diff(timestamp_s)[:, None]
    rate = np.concatenate([rate, rate[-1:]])
    return np.stack([-rate[:, 1], rate[:, 0]], axis=-1) * focal_px * shutter_s


def gains(
    rng: np.random.Generator, timestamp_s: Float[np.ndarray, "frame"], exposure: Exposure
) -> Float[np.ndarray, "frame"]:
    """Return the automatic exposure's slow wander, around 1."""
    return np.exp(exposure.gain_wander * _slow(rng, timestamp_s, 2.5))


def _smeared(linear: np.ndarray, blur_px: np.ndarray) -> np.ndarray:
    length = float(np.hypot(*blur_px))
    if length < 0.6:
        return linear
    length = min(length, 9.0)
    size = 2 * int(np.ceil(length / 2)) + 1
    kernel = np.zeros((size, size), np.float32)
    direction = blur_px / np.hypot(*blur_px)
    for share in np.linspace(-0.5, 0.5, 4 * size):
        x, y = size // 2 + share * length * direction
        i, j = int(y), int(x)
        for di in (0, 1):
            for dj in (0, 1):
                if i + di < size and j + dj < size:
                    kernel[i + di, j + dj] += (1 - abs(y - i - di)) * (1 - abs(x - j - dj))
    return cv2.filter2D(linear, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)


def _slow(rng: np.random.Generator, timestamp_s: np.ndarray, seconds: float) -> Float[np.ndarray, "frame"]:
    """Return smooth noise of unit standard deviation over time."""
    grid = np.arange(-4 * seconds, timestamp_s[-1] + 4 * seconds, seconds / 5)
    noise = gaussian_filter1d(rng.standard_normal(len(grid)), 5) * np.sqrt(2 * np.sqrt(np.pi) * 5)
    return np.interp(timestamp_s, grid, noise)
