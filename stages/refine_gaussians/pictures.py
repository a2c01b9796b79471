"""Pictures and figures of the Gaussians for the report."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from pipeline.core.training import FitRecord
from pipeline.data import plots, qa
from pipeline.fields.gaussians import render
from stages.refine_gaussians.refine import FrameLoss
from stages.refine_gaussians.views import DrawnVideo, read


def report_quality(folder: Path, loss: FrameLoss, videos: Sequence[DrawnVideo], record: FitRecord) -> None:
    """Write qa.json: PSNR over a few frames of every session, pictures of them."""
    rows, psnrs = [], []
    for video in videos:
        if video.appearance is None or video.masks is None:
            continue
        frames = video.usable_frames()
        for frame in frames[:: max(1, len(frames) // 3)][:3]:
            image, psnr = compare(loss, video, frame)
            psnrs.append(psnr)
            rows.append(image)
    color = record.terms.get("color", np.array([np.nan]))
    window = max(1, len(color) // 10)
    psnr = float(np.mean(psnrs)) if psnrs else None
    ratio = float(np.nanmean(color[-window:]) / np.nanmean(color[:window]))
    checks = [
        qa.Check("PSNR of drawn training frames", psnr, "dB", 20, 15, "higher"),
        qa.Check("color error of the last tenth against the first", ratio, "ratio", 1.0, 1.3),
    ]
    pictures = []
    if rows:
        shown = plots.grid(rows[:6], 1)
        pictures = [qa.Picture("frames", shown, "picture, Gaussians, depth, the agent's share")]
    qa.write(
        folder,
        good="sharper pictures than the fields give, an agent of its own",
        bad="needles, fog, an agent that leaves color in the room",
        checks=checks,
        pictures=pictures,
    )


@torch.no_grad()
def compare(
    loss: FrameLoss, video: DrawnVideo, frame: int
) -> tuple[UInt8[np.ndarray, "height width 3"], float]:
    """Draw one frame beside its picture; return the row of pictures and the PSNR."""
    size = video.drawn_size(loss.long_side_px)
    target = read(video, frame, size, loss.device)
    camera = loss.camera(video, frame)
    cloud = loss.cloud(video, frame, camera, target)
    view = render(cloud, camera, target.intrinsics, *size, backend=loss.backend)
    error = (view.color.clamp(0, 1) - target.color).square().mean()
    depth = plots.depth_colors(view.depth.cpu().numpy())
    agent = view.agent[..., None].expand(-1, -1, 3)
    shown = [(image.clamp(0, 1) * 255).byte().cpu().numpy() for image in (target.color, view.color, agent)]
    return np.hstack([shown[0], shown[1], depth, shown[2]]), float(-10 * torch.log10(error.clamp_min(1e-9)))
