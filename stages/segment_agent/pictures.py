"""What the report shows of masks: overlays, the mask's area over time, and figures with thresholds."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.files.clips import Clip
from pipeline.qa import Check, Picture

GREEN, BLUE = np.array([60, 255, 90]), np.array([60, 90, 255])


def overlay(color: UInt8[np.ndarray, "height width 3"], labels: UInt8[np.ndarray, "height width"]) -> UInt8[np.ndarray, "height width 3"]:
    """Draw the agent's outline in green and unknown pixels in blue."""
    picture = color.astype(np.float32) * np.where(labels == 0, 0.6, 1.0)[..., None]
    picture[labels == 128] = 0.4 * picture[labels == 128] + 0.6 * BLUE
    inside = (labels == 255).astype(np.uint8)
    picture[(cv2.dilate(inside, np.ones((3, 3), np.uint8)) > inside)] = GREEN
    return picture.astype(np.uint8)


def contact_sheet(
    clip: Clip, labels: dict[int, UInt8[np.ndarray, "height width"]], columns: int = 6, width_px: int = 200
) -> UInt8[np.ndarray, "height width 3"]:
    """Lay overlays of some frames out in a grid."""
    height_px = round(width_px * clip.color_size[0] / clip.color_size[1])
    tiles = [
        cv2.resize(overlay(clip.color(frame), mask), (width_px, height_px), interpolation=cv2.INTER_AREA) for frame, mask in labels.items()
    ]
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % columns)
    return np.vstack([np.hstack(tiles[start : start + columns]) for start in range(0, len(tiles), columns)])


def area_strip(
    area: Float[np.ndarray, "frame"], visible: Bool[np.ndarray, "frame"], height_px: int = 80
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw the mask's share of the picture over time; frames without the agent are dark red."""
    step = max(1, 720 // max(len(area), 1))
    strip = np.full((height_px, len(area) * step, 3), 24, np.uint8)
    for frame, share in enumerate(area):
        columns = slice(frame * step, (frame + 1) * step)
        if not visible[frame]:
            strip[:, columns] = (70, 20, 20)
        top = height_px - round(height_px * float(share / max(area.max(), 1e-6)))
        strip[top:, columns] = GREEN
    return strip


def flicker(area: Float[np.ndarray, "frame"], visible: Bool[np.ndarray, "frame"]) -> float:
    """Return the median change of the area between neighbouring frames as a share of it."""
    both = visible[1:] & visible[:-1]
    if not both.any():
        return float("nan")
    return float(np.median(np.abs(np.diff(area))[both] / np.maximum(area[1:], area[:-1])[both]))


def report(
    clip: Clip, labels: dict[int, np.ndarray], area: np.ndarray, visible: np.ndarray, residual_m: float
) -> tuple[list[Check], list[Picture]]:
    """Return the stage's figures and pictures."""
    checks = [
        Check("agent visible", 100 * float(visible.mean()), "%", warn=30, fail=2, better="higher"),
        Check("flicker", 100 * flicker(area, visible), "%", warn=15, fail=40),
    ]
    if np.isfinite(residual_m):
        checks.append(Check("agreement of depth pictures", 1000 * residual_m, "mm", warn=25, fail=60))
    pictures = [
        Picture("overlay", contact_sheet(clip, labels), "masks over frames: outline green, unknown blue"),
        Picture("area", area_strip(area, visible), "share of the picture over time, red where the agent is out of view"),
    ]
    return checks, pictures
