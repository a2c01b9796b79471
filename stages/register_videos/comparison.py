"""Recorded pictures and the template rendered from their poses, at half size, and their correlation."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Num, UInt8

from pipeline.data.clips import Clip, Masks
from pipeline.geometry import cameras, rigid, subsampling
from pipeline.geometry.meshes import Mesh, RayCaster, render_view
from pipeline.mapping.picture_agreement import beats, correlated
from pipeline.metrics.silhouettes import silhouette_iou

BLUR_PX = 9.0
"""Neighborhood of the local contrast normalization, standard deviation in half-size pixels."""
MIN_VARIANCE = 9.0
"""Floor of the local variance of gray values."""
MEAN_GRAY, GRAY_PER_SIGMA = 128, 48
"""Output gray value of the local mean, and gray values per standard deviation."""
SHARE_FLOOR = 1e-3
"""Added to the share of known pixels, against division by zero."""
FIT_M, MIN_SHARE = 0.05, 0.1
"""Pixels are compared where depth and rendering agree within the first, meters; frames with a smaller share
of such pixels have no score."""
SMOOTHING_PX = 1.5
"""Blur before correlation, half-size pixels, to match the template's smooth colors."""

SIZES, SIZE_FRAMES = (0.8, 0.9, 1.1, 1.25), 40
"""Other sizes of the animal's template that are compared with its own, and number of frames compared."""


@dataclass(frozen=True)
class RenderedComparison:
    """One recorded and rendered frame, at half the picture's size."""

    intrinsics: Float[np.ndarray, "3 3"]
    depth: Float[np.ndarray, "height width"]
    """Of the template, meters, 0 = none."""
    rendered: Float[np.ndarray, "height width 3"]
    recorded: UInt8[np.ndarray, "height width 3"]
    known: Bool[np.ndarray, "height width"]
    """Template visible, and certainly no animal."""


def compare(
    clip: Clip, masks: Masks, caster: RayCaster, frame: int, world_from_camera: Float[np.ndarray, "4 4"]
) -> RenderedComparison:
    """Render the template from the pose of a frame."""
    size = (clip.color_size[0] // 2, clip.color_size[1] // 2)
    intrinsics = cameras.scale_intrinsics(clip.intrinsics[frame], clip.color_size, size)
    depth, hits = render_view(caster, world_from_camera, intrinsics, *size)
    assert caster.mesh.color is not None, "templates have colors"
    rendered = hits.interpolate(caster.mesh, caster.mesh.color).reshape(*size, 3)
    recorded = cv2.resize(clip.color(frame), size[::-1], interpolation=cv2.INTER_AREA)
    free = cv2.resize((masks[frame] == 0).astype(np.uint8), size[::-1], interpolation=cv2.INTER_NEAREST) > 0
    return RenderedComparison(intrinsics, depth, rendered, recorded, (depth > 0) & free)


def local_contrast_normalization(
    color: Num[np.ndarray, "height width 3"], known: Bool[np.ndarray, "height width"]
) -> UInt8[np.ndarray, "height width"]:
    """Normalize gray values by their local mean and standard deviation (Jarrett et al. 2009)."""
    gray = cv2.cvtColor(color.astype(np.float32), cv2.COLOR_RGB2GRAY)
    weight = known.astype(np.float32)
    share = _blur(weight) + SHARE_FLOOR
    mean = _blur(gray * weight) / share
    deviation = np.sqrt(np.maximum(_blur((gray - mean) ** 2 * weight) / share, MIN_VARIANCE))
    return np.clip(MEAN_GRAY + GRAY_PER_SIGMA * (gray - mean) / deviation * weight, 0, 255).astype(np.uint8)


def _blur(picture):
    return cv2.GaussianBlur(picture, (0, 0), BLUR_PX)


def ncc(
    clip: Clip, masks: Masks, caster: RayCaster, frame: int, world_from_camera: Float[np.ndarray, "4 4"]
) -> float:
    """Return the normalized cross-correlation of one frame with its rendering, where their depth agrees.

    In -1..1; NaN where too few pixels are comparable.
    """
    pair = compare(clip, masks, caster, frame, world_from_camera)
    depth = cv2.resize(clip.depth(frame), pair.depth.shape[::-1], interpolation=cv2.INTER_NEAREST)
    comparable = pair.known & (np.abs(depth - pair.depth) < FIT_M)
    if comparable.mean() < MIN_SHARE:
        return np.nan
    normalized = [
        local_contrast_normalization(picture, pair.known).astype(np.float64)
        for picture in (pair.rendered, pair.recorded)
    ]
    return correlated(*(cv2.GaussianBlur(each, (0, 0), SMOOTHING_PX)[comparable] for each in normalized))


@dataclass(frozen=True)
class AnimalSize:
    """How well the template's silhouette fits the masks, in its own size and in the best other one."""

    iou: float
    """Median intersection over union in its own size; NaN if no frame shows enough."""
    frames: int
    better: float | None = None
    """Factor on the size that fits significantly more frames better; None if there is none."""
    better_iou: float = np.nan


def compare_sizes(
    clip: Clip,
    masks: Masks,
    agent: Mesh,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    world_from_agent: Float[np.ndarray, "frame 4 4"],
) -> AnimalSize:
    """Compare silhouettes of the placed template with the masks; other sizes stand on the same ground.

    Legs and tail move, so even the right animal does not fill its mask. But no other size does it better,
    unless the recording shows another animal than the turnaround, or lengths of the two differ.
    """
    frames = subsampling.some(np.flatnonzero(np.isfinite(world_from_agent[:, 0, 0])), SIZE_FRAMES).tolist()

    def ious(factor: float) -> Float[np.ndarray, "compared"]:
        vertices = factor * agent.vertices
        vertices[:, 1] += agent.vertices[:, 1].min() - vertices[:, 1].min()
        caster = RayCaster(replace(agent, vertices=vertices.astype(np.float32)))
        return np.array(
            [
                silhouette_iou(clip, masks, caster, frame, rigid.inverse(root) @ camera)
                for frame, root, camera in zip(
                    frames, world_from_agent[frames], world_from_camera[frames], strict=True
                )
            ]
        )

    own = ious(1.0)
    known = int(np.isfinite(own).sum())
    size = AnimalSize(float(np.nanmedian(own)) if known else np.nan, known)
    for factor in SIZES:
        other = ious(factor)
        if beats(other, own, len(SIZES)):
            iou = float(np.nanmedian(other))
            size = replace(size, better=factor, better_iou=iou) if not iou <= size.better_iou else size
    return size
