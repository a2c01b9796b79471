"""The reconstruction seen by the held-out phone: depth within 0.1 m, PSNR and SSIM, all / agent / scene."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8
from skimage.metrics import structural_similarity

from pipeline.geometry import subsampling
from pipeline.metrics.lpips import Lpips
from pipeline.metrics.metrics import Metrics, mean

UNSEEN = "no held-out phone, or none that films while its session does"
NO_LPIPS = "LPIPS needs the weights of AlexNet: name their folder in `[evaluate] lpips_weights`"
UNMEASURED_LPIPS = "not in view of the held-out phone, or its pictures are smaller than 63 pixels"
TOLERANCE_M = 0.1
RANGE_M = 5.0
PARTS = ("all", "agent", "scene")
KINDS = ("depth_acc", "rendered_depth_acc", "psnr", "ssim", "lpips")
RENDERED_PIXELS = 12_000
"""Pixels of all pictures together on whose rays fields are integrated: shares are then within 0.01 (95 %),
and it takes seconds."""
FILMED_SHARE = 0.01
"""Share of the session's picture above which its phone films the agent."""
FILMED = ("reconstruction/depth_acc_agent_filmed", "reconstruction/agent_filmed_share")
NAMES = (
    *FILMED,
    *(f"reconstruction/{kind}_{part}" for kind in KINDS for part in PARTS),
    *(f"splats/{kind}_{part}" for kind in ("psnr", "ssim") for part in PARTS),
)


@dataclass(frozen=True)
class HeldoutShot:
    """The true picture and depth of the held-out phone at one time."""

    world_from_camera: Float[np.ndarray, "4 4"]
    """in our world"""
    intrinsics: Float[np.ndarray, "3 3"]
    time_s: float
    """on the clock of the session that it is synchronized with"""
    color: UInt8[np.ndarray, "height width 3"]
    depth: Float[np.ndarray, "height width"]
    agent: Bool[np.ndarray, "height width"]
    session_share: float = np.nan
    """Share of the session's own picture, at that time, that truly shows the agent; NaN: not known."""

    def every(self, stride: int) -> "HeldoutShot":
        """Return the shot of the same camera with one pixel of ``stride`` x ``stride``, from the middle."""
        first = min(stride // 2, *(side - 1 for side in self.depth.shape))
        chosen = np.s_[first::stride, first::stride]
        intrinsics = np.array(self.intrinsics, float)
        intrinsics[:2, 2] -= first + 0.5 - 0.5 * stride
        intrinsics[:2] /= stride
        color, depth, agent = (image[chosen] for image in (self.color, self.depth, self.agent))
        return replace(self, intrinsics=intrinsics, color=color, depth=depth, agent=agent)


@dataclass(frozen=True)
class HeldoutView:
    """A true picture and ours of the same camera and time."""

    color: UInt8[np.ndarray, "height width 3"]
    depth: Float[np.ndarray, "height width"]
    """meters, 0 = nothing"""
    true: HeldoutShot

    @classmethod
    def empty(cls, true: HeldoutShot) -> "HeldoutView":
        """Return an empty rendering, for refused sessions."""
        return cls(np.zeros_like(true.color), np.zeros_like(true.depth), true)


def view_metrics(views: Sequence[HeldoutView], lpips: Lpips | None = None) -> Metrics:
    """Average over all pixels (depth) and over pictures (PSNR, SSIM, LPIPS).

    Phones may differ in the shape of their pictures. Without ``lpips`` LPIPS is not measured.
    """
    metrics = depth_metrics("reconstruction/depth_acc", views)
    metrics.add(filmed_metrics(views))
    metrics.add(picture_metrics("reconstruction", views))
    names = [f"reconstruction/lpips_{part}" for part in PARTS]
    if lpips is None:
        metrics.skip(names, NO_LPIPS)
    else:
        rows = np.array([_per_part(lpips.distance(*compared_colors(view)), view) for view in views])
        for name, column in zip(names, rows.T, strict=True):
            metrics.put(name, mean(column[np.isfinite(column)]), UNMEASURED_LPIPS)
    return metrics


def depth_metrics(name: str, views: Sequence[HeldoutView]) -> Metrics:
    """Average over all pixels whether depth is right (DepthAcc@0.1m); holes are wrong."""
    metrics = Metrics()
    known = np.concatenate([((view.true.depth > 0) & (view.true.depth <= RANGE_M)).ravel() for view in views])
    errors = (np.where(view.depth > 0, np.abs(view.depth - view.true.depth), np.inf) for view in views)
    right = np.concatenate([(error <= TOLERANCE_M).ravel() for error in errors])
    agent = np.concatenate([view.true.agent.ravel() for view in views])
    for part, chosen in (("all", known), ("agent", known & agent), ("scene", known & ~agent)):
        metrics.put(f"{name}_{part}", mean(right[chosen]), "not in view of the held-out phone")
    return metrics


def filmed_metrics(views: Sequence[HeldoutView]) -> Metrics:
    """Average DepthAcc of the agent over the pictures in which the session's own phone films it too, and give
    the share of these pictures among those that show the agent; elsewhere its pose is a guess.
    """
    metrics, shown = Metrics(), [view for view in views if view.true.agent.any()]
    if not shown or not all(np.isfinite(view.true.session_share) for view in shown):
        metrics.skip(FILMED, "what the session's phone truly saw is not known")
        return metrics
    filmed = [view for view in shown if view.true.session_share >= FILMED_SHARE]
    value = depth_metrics("filmed", filmed).values["filmed_agent"] if filmed else np.nan
    metrics.put(FILMED[0], np.nan if value is None else value, "the session's phone does not film the agent")
    metrics.put(FILMED[1], len(filmed) / len(shown))
    return metrics


def thinned(shots: Sequence[HeldoutShot], pixels: int) -> list[HeldoutShot]:
    """Keep every so many rows and columns, so that about ``pixels`` remain of all shots together."""
    stride = int(np.ceil(np.sqrt(sum(shot.depth.size for shot in shots) / pixels)))
    return [shot.every(max(stride, 1)) for shot in shots]


def picture_metrics(name: str, views: Sequence[HeldoutView]) -> Metrics:
    """Average PSNR and SSIM over pictures."""
    metrics, rows = Metrics(), np.array([picture_quality(view) for view in views])
    for column, (kind, part) in enumerate((kind, part) for kind in ("psnr", "ssim") for part in PARTS):
        values = rows[:, column][np.isfinite(rows[:, column])]
        metrics.put(f"{name}/{kind}_{part}", mean(values), "not in view of the held-out phone")
    return metrics


def side_by_side(views: Sequence[HeldoutView], count: int = 6) -> UInt8[np.ndarray, "height width 3"]:
    """Tile some views: truth, ours, true depth, our depth."""
    chosen = [views[index] for index in subsampling.evenly(len(views), count)]
    columns = [(view.true.color, view.color, _gray(view.true.depth), _gray(view.depth)) for view in chosen]
    height = max(len(column[0]) for column in columns)
    padded = [
        [np.pad(image, ((0, height - len(image)), (0, 0), (0, 0))) for image in column] for column in columns
    ]
    return np.concatenate([np.concatenate(column) for column in padded], axis=1)


def _gray(depth: Float[np.ndarray, "height width"]) -> UInt8[np.ndarray, "height width 3"]:
    near = np.where(depth > 0, 255 * (1 - np.minimum(depth, RANGE_M) / RANGE_M), 0)
    return np.repeat(near.astype(np.uint8)[..., None], 3, axis=-1)


def picture_quality(view: HeldoutView) -> list[float]:
    """Return PSNR (all, agent, scene) in dB, then SSIM; NaN for a part that is not in the picture."""
    ours, true = compared_colors(view)
    squared = ((ours - true) ** 2).mean(-1)
    similar = structural_similarity(true, ours, channel_axis=-1, data_range=1.0, full=True)[1].mean(-1)
    psnr = [-10 * np.log10(max(error, 1e-10)) for error in _per_part(squared, view)]
    return psnr + _per_part(similar, view)


def compared_colors(
    view: HeldoutView,
) -> tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width 3"]]:
    """Return our colors, their exposure compensated, and the true ones; 0..1."""
    true = view.true.color.astype(np.float64) / 255
    return exposed(view.color.astype(np.float64) / 255, true, view.depth > 0), true


def _per_part(values: Float[np.ndarray, "height width"], view: HeldoutView) -> list[float]:
    """Average over all pixels, the agent's and the scene's; NaN for a part that is not in the picture."""
    parts = (np.ones_like(view.true.agent), view.true.agent, ~view.true.agent)
    return [mean(values[part]) for part in parts]


def exposed(
    ours: Float[np.ndarray, "height width 3"],
    true: Float[np.ndarray, "height width 3"],
    drawn: Bool[np.ndarray, "height width"],
) -> Float[np.ndarray, "height width 3"]:
    """Compensate exposure by one affine map of colors, fitted on what was drawn; 0..1."""
    if drawn.sum() < 16:
        return ours
    source = np.concatenate([ours[drawn], np.ones((int(drawn.sum()), 1))], axis=1)
    affine = np.linalg.lstsq(source, true[drawn], rcond=None)[0]
    return np.clip(ours @ affine[:3] + affine[3], 0, 1)
