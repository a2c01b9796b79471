"""Pictures and metrics of the reconstruction for the report: picture, render, depth, opposite view, bones."""

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.core.training import FitRecord
from pipeline.data import plots, qa
from pipeline.data.clips import Clip, Masks
from pipeline.data.motion import Motion
from pipeline.fields.fields import Reconstruction
from pipeline.fields.render import Renderer
from pipeline.geometry import cameras, rigid, subsampling

LONG_SIDE_PX = 320
"""of each drawn picture"""
ACROSS_M, ABOVE_M = 0.8, 0.6
"""distance beyond the agent, and maximum height above it, of the camera of the opposite view"""
AXIS_M = 0.03
"""length of a bone's drawn axes"""
FARTHEST_PX = 1 << 20
"""drawn points are clamped here, in sixteenths of a pixel, to avoid integer overflow in OpenCV"""
FRAMES = 16
"""frames that are compared, of all sessions alike"""


def report_quality(
    folder: Path,
    reconstruction: Reconstruction,
    motions: Mapping[str, Motion],
    frames: Mapping[str, Path],
    masks: Mapping[str, Path],
    records: Mapping[str, FitRecord],
) -> None:
    """Write qa.json: agreement with the sensor on a few frames of every session, with pictures."""
    rows, pictures, each = [], [], -(-FRAMES // max(len(motions), 1))
    for id, motion in motions.items():
        clip, labels = Clip.open(frames[id]), Masks.open(masks[id])
        renderer, chosen = Renderer(reconstruction, id), chosen_frames(motion, each)
        compared = [compare(renderer, clip, labels[frame], motion, frame) for frame in chosen]
        rows += [metrics for metrics, _ in compared]
        if compared and len(pictures) < 3:
            image = np.vstack([image for _, image in compared[:3]])
            caption = f"{id}: picture, render, depth measured and rendered, opposite view, bones"
            pictures.append(qa.Picture(f"{id}_frames", image, caption))
    curves = plots.loss_curves({name: {"total": record.total()} for name, record in records.items()})
    pictures.append(qa.Picture("losses", curves, "losses of each phase, running mean, logarithmic"))
    psnr, depth, iou = np.ma.masked_invalid(np.reshape(rows, (-1, 3))).mean(0).filled(np.nan).tolist()
    checks = [
        qa.Check("PSNR of rendered training frames", psnr, "dB", 20, 15, "higher"),
        qa.Check("measured depth reproduced within 0.1 m", depth, "share", 0.9, 0.75, "higher"),
        qa.Check("agent's silhouette against its mask, IoU", iou, "share", 0.7, 0.5, "higher"),
    ]
    qa.write(
        folder,
        good="renders that match pictures and depth, bones inside the body",
        bad="ghosts, a body beside its mask, bones torn apart",
        checks=checks,
        pictures=pictures,
    )


def chosen_frames(motion: Motion, number: int) -> list[int]:
    """Choose frames spread over those where camera and agent are known."""
    known = np.flatnonzero(
        np.isfinite(motion.world_from_agent).all((1, 2))
        & np.isfinite(motion.world_from_camera).all((1, 2))
        & motion.agent_visible
    )
    return subsampling.some(known, number).tolist()


def compare(
    renderer: Renderer, clip: Clip, mask: UInt8[np.ndarray, "height width"], motion: Motion, frame: int
) -> tuple[tuple[float, float, float], UInt8[np.ndarray, "height width 3"]]:
    """Render one frame; return (PSNR, share of depth within 0.1 m, IoU) and one row of pictures."""
    height, width = (round(side * LONG_SIDE_PX / max(clip.color_size)) for side in clip.color_size)
    intrinsics = cameras.scale_intrinsics(clip.intrinsics[frame], clip.color_size, (height, width))
    camera, root, bones = (
        poses[frame] for poses in (motion.world_from_camera, motion.world_from_agent, motion.agent_from_bone)
    )
    drawn = renderer.draw(camera, intrinsics, height, width, root, bones)
    color = plots.resized(clip.color(frame), (height, width))
    measured = cv2.resize(clip.depth(frame), (width, height), interpolation=cv2.INTER_NEAREST)
    opposite = renderer.draw(_opposite(camera, root), intrinsics, height, width, root, bones)
    depths = [plots.depth_colors(depth) for depth in (measured, drawn.depth)]
    row = [color, drawn.color, *depths, opposite.color, draw_bones(color, camera, intrinsics, root, bones)]
    known = (measured > 0.1) & (measured < 5)
    agent = cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST) == 255
    error = np.mean((color.astype(float) - drawn.color)[drawn.depth > 0] ** 2)
    iou = (agent & drawn.agent).sum() / max((agent | drawn.agent).sum(), 1)
    share = np.mean(np.abs(drawn.depth - measured)[known] < 0.1) if known.any() else np.nan
    return (10 * np.log10(255**2 / max(error, 1e-6)), float(share), float(iou)), np.hstack(row)


def _opposite(
    world_from_camera: Float[np.ndarray, "4 4"], world_from_agent: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "4 4"]:
    """Return a camera on the other side of the agent, at the same height and near, so before any wall."""
    target, eye = world_from_agent[:3, 3], world_from_camera[:3, 3]
    beyond = (target - eye)[[0, 2]]
    beyond *= min(1.0, ACROSS_M / max(np.linalg.norm(beyond), 1e-6))
    across = np.array([target[0] + beyond[0], min(eye[1], target[1] + ABOVE_M), target[2] + beyond[1]])
    return rigid.look_at(across, target, np.array([0.0, 1.0, 0.0]))


def draw_bones(
    image: UInt8[np.ndarray, "height width 3"],
    world_from_camera: Float[np.ndarray, "4 4"], intrinsics: Float[np.ndarray, "3 3"],
    world_from_agent: Float[np.ndarray, "4 4"], agent_from_bone: Float[np.ndarray, "bone 4 4"],
) -> UInt8[np.ndarray, "height width 3"]:  # fmt: skip
    """Draw each bone's axes (x red, y green, z blue) over a picture."""
    camera_from_bone = rigid.inverse(world_from_camera) @ world_from_agent @ agent_from_bone
    tips = np.concatenate([np.zeros((1, 3)), AXIS_M * np.eye(3)])
    pixel = cameras.project(rigid.apply(camera_from_bone, tips[None]), intrinsics)[0]
    ends, drawn = np.rint(np.clip(pixel * 16, -FARTHEST_PX, FARTHEST_PX)).astype(int), image.copy()
    for bone in ends.tolist():
        for axis, color in enumerate(np.diag([255] * 3).tolist()):
            cv2.line(drawn, bone[0], bone[1 + axis], color, 1, cv2.LINE_AA, shift=4)
    return drawn
