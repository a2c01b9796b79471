"""Fit a colored mesh to a picture by its outline and colors, where depth is not measured.

`body_picture` crops a picture around a mask, `residuals` compares it with the mesh rendered from a pose,
`calibrated` learns how large residuals of a recording typically are, `search` improves a pose.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.geometry import cameras, rigid
from pipeline.geometry.meshes import Mesh, RayCaster

SIZE_PX, MARGIN = 32, 0.25
"""Longer side of the mask in the crop, pixels; margin around it, in longer sides."""
ROUNDS, SHRINK, HALVED = 5, 0.8, 0.5
"""Sweeps of the pattern search over all axes; factors on its steps after one that improved, and another."""
ROUGH, LEAST = (0.35, 35.0), (0.02, 1.0)
"""Typical residuals of outline (1 - IoU) and color (sum over Lab) before they are learned, and least ones."""
UNRELATED = 150.0
"""Color difference of surfaces that have nothing in common, sum over Lab."""
STEPS = (0.08, 0.15, 0.04, float(np.deg2rad(15.0)), float(np.deg2rad(12.0)))
"""First steps to the side, away from the camera and up (body lengths), in heading and in pitch (radians)."""


@dataclass(frozen=True)
class ColoredBody:
    """The mesh, and typical residuals of its renderings in a recording."""

    caster: RayCaster
    lab: Float[np.ndarray, "vertex 3"]
    """8-bit CIE Lab, as the picture's."""
    exposure: Float[np.ndarray, "3"]
    """Picture minus mesh, Lab: exposure and white balance differ between recordings."""
    typical: Float[np.ndarray, "2"]
    """Typical residuals of outline and color."""

    def misfit(self, picture: "BodyPicture", world_from_body: Float[np.ndarray, "4 4"]) -> float:
        """Return the mean of both residuals, relative to typical ones."""
        return float((residuals(picture, self, world_from_body) / self.typical).mean())


@dataclass(frozen=True)
class BodyPicture:
    """A small picture around the body; pixels in row-major order."""

    rays_camera: Float[np.ndarray, "pixel 3"]
    lab: Float[np.ndarray, "pixel 3"]
    inside: Bool[np.ndarray, "pixel"]
    known: Bool[np.ndarray, "pixel"]
    """The mask is certain."""
    depth: Float[np.ndarray, "pixel"]
    """Of what surrounds the body, meters; 0 = unknown."""
    world_from_camera: Float[np.ndarray, "4 4"]


def colored_body(mesh: Mesh) -> ColoredBody:
    """Return a mesh to be compared with pictures; ``mesh`` must have colors."""
    assert mesh.color is not None, "templates have colors"
    return ColoredBody(RayCaster(mesh), lab(mesh.color[None])[0], np.zeros(3), np.array(ROUGH))


def body_picture(
    color: UInt8[np.ndarray, "height width 3"],
    mask: UInt8[np.ndarray, "height width"],
    depth: Float[np.ndarray, "depth_height depth_width"],
    intrinsics: Float[np.ndarray, "3 3"],
    world_from_camera: Float[np.ndarray, "4 4"],
) -> BodyPicture:
    """Crop a picture around a mask (255 inside, 128 uncertain), which must not be empty, and shrink it."""
    depth = cv2.resize(depth, mask.shape[::-1], interpolation=cv2.INTER_NEAREST)
    rows, columns = np.nonzero(mask == 255)
    first, last = np.array([rows.min(), columns.min()]), np.array([rows.max(), columns.max()]) + 1
    side = int((last - first).max())
    low = np.maximum(first - int(MARGIN * side), 0)
    high = np.minimum(last + int(MARGIN * side), mask.shape)
    scale = min(1.0, SIZE_PX / side)
    height, width = (max(int(length * scale), 1) for length in high - low)
    cut, moved = np.s_[low[0] : high[0], low[1] : high[1]], intrinsics.copy()
    moved[:2, 2] -= low[::-1]
    lens = cameras.scale_intrinsics(moved, (high[0] - low[0], high[1] - low[1]), (height, width))
    small = cv2.resize(color[cut], (width, height), interpolation=cv2.INTER_AREA)
    labels, depth = (
        cv2.resize(each[cut], (width, height), interpolation=cv2.INTER_NEAREST).ravel()
        for each in (mask, depth)
    )
    rays = cameras.ray_directions(lens, height, width).reshape(-1, 3)
    colors = lab(small).reshape(-1, 3)
    return BodyPicture(rays, colors, labels == 255, labels != 128, depth, world_from_camera)


def residuals(
    picture: BodyPicture, body: ColoredBody, world_from_body: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "2"]:
    """Return 1 - IoU of outline and mask, and the mean color difference where both are (sum over Lab)."""
    silhouette, shown = _rendered(picture, body, world_from_body)
    both, either = silhouette & picture.inside, (silhouette | picture.inside) & picture.known
    off = np.abs(picture.lab[both] - shown[both] - body.exposure).sum(-1)
    iou = both.sum() / max(either.sum(), 1)
    return np.array([1 - iou, off.mean() if len(off) else UNRELATED])


def calibrated(
    body: ColoredBody, pictures: list[BodyPicture], world_from_body: Float[np.ndarray, "picture 4 4"]
) -> ColoredBody:
    """Return the body with exposure and typical residuals as of pictures with rough poses (medians)."""
    pairs, off = list(zip(pictures, world_from_body, strict=True)), []
    for picture, pose in pairs:
        silhouette, shown = _rendered(picture, body, pose)
        both = silhouette & picture.inside
        off.append(picture.lab[both] - shown[both])
    pixels = np.concatenate(off)
    exposed = replace(body, exposure=np.median(pixels, axis=0) if len(pixels) else body.exposure)
    found = [residuals(picture, exposed, pose) for picture, pose in pairs]
    return replace(exposed, typical=np.maximum(np.median(found, axis=0), LEAST))


def search(
    world_from_body: Float[np.ndarray, "4 4"],
    objective: Callable[[Float[np.ndarray, "4 4"]], float],
    eye_world: Float[np.ndarray, "3"],
    length_m: float,
) -> Float[np.ndarray, "4 4"]:
    """Minimize an objective by pattern search (Hooke and Jeeves 1961) over position, heading and pitch."""
    pose, steps = world_from_body, np.array(STEPS) * ([length_m] * 3 + [1] * 2)
    least = objective(pose)
    for _ in range(ROUNDS):
        before = least
        for axis in range(len(steps)):
            for step in (steps[axis], -steps[axis]):
                moved = _moved(pose, step * np.eye(len(steps))[axis], eye_world)
                if (value := objective(moved)) < least:
                    pose, least = moved, value
                    break
        steps *= SHRINK if least < before else HALVED
    return pose


def _moved(pose, step, eye_world):
    """Move to the side, away from the camera and up, turn about the vertical, and pitch."""
    away = (pose[:3, 3] - eye_world) * (1, 0, 1)
    away /= max(float(np.linalg.norm(away)), 1e-6)
    side = np.cross(away, (0.0, 1.0, 0.0))
    turn, pitch = rigid.rotation_from_yaw(step[3]), rigid.rotation_from_vector(np.array([step[4], 0, 0]))
    shift = step[0] * side + step[1] * away + step[2] * np.array([0.0, 1.0, 0.0])
    return rigid.make(turn @ pose[:3, :3] @ pitch, pose[:3, 3] + shift)


def _rendered(picture, body, world_from_body):
    """Return where the body is seen, and its colors there; what surrounds it may hide it."""
    body_from_camera = rigid.inverse(world_from_body) @ picture.world_from_camera
    hits = body.caster.cast(body_from_camera[:3, 3], picture.rays_camera @ body_from_camera[:3, :3].T)
    vertex = body.caster.mesh.faces[np.maximum(hits.face, 0), hits.barycentric.argmax(-1)]
    hidden = ~picture.inside & (picture.depth > 0) & (picture.depth < hits.distance)
    return (hits.face >= 0) & ~hidden, body.lab[vertex]


def lab(color: UInt8[np.ndarray, "height width channel"]) -> Float[np.ndarray, "height width 3"]:
    """Convert RGB, or RGBA without its alpha, to CIE Lab of 8 bits: 0..255 each, a and b around 128."""
    return cv2.cvtColor(np.ascontiguousarray(color[..., :3]), cv2.COLOR_RGB2LAB).astype(np.float32)
