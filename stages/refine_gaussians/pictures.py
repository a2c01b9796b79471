"""Pictures and figures of the Gaussians for the report."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import UInt8

from pipeline import qa
from pipeline.fit import FitRecord
from pipeline.models.gaussians import see
from stages.refine_gaussians.refine import FrameLoss, Sequence4D, usable_frames
from stages.refine_gaussians.views import drawn_size, read

DEPTH_RANGE_M = 4.0


def report_quality(folder: Path, loss: FrameLoss, sequences: Sequence[Sequence4D], record: FitRecord) -> None:
    """Write qa.json: PSNR over a few frames of every session, pictures of them."""
    rows, figures = [], []
    for sequence in sequences:
        if sequence.video is None or sequence.recording.masks is None:
            continue
        frames = usable_frames(sequence)
        for frame in frames[:: max(1, len(frames) // 3)][:3]:
            image, psnr = compare(loss, sequence, frame)
            figures.append(psnr)
            rows.append(image)
    color = record.terms.get("color", np.array([np.nan]))
    window = max(1, len(color) // 10)
    checks = [
        qa.Check("PSNR of drawn training frames", float(np.mean(figures)) if figures else None, "dB", 20, 15, "higher"),
        qa.Check(
            "colour error of the last tenth against the first",
            float(np.nanmean(color[-window:]) / np.nanmean(color[:window])),
            "ratio",
            1.0,
            1.3,
        ),
    ]
    pictures = [qa.Picture("frames", stacked(rows[:6]), "picture, Gaussians, depth, the agent's share")] if rows else []
    qa.write(
        folder,
        good="sharper pictures than the fields give, an agent of its own",
        bad="needles, fog, an agent that leaves colour in the room",
        checks=checks,
        pictures=pictures,
    )


def stacked(rows: Sequence[UInt8[np.ndarray, "height width 3"]]) -> UInt8[np.ndarray, "height width 3"]:
    """Put pictures of different widths below each other, on white."""
    width = max(row.shape[1] for row in rows)
    return np.vstack([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in rows])


@torch.no_grad()
def compare(loss: FrameLoss, sequence: Sequence4D, frame: int) -> tuple[UInt8[np.ndarray, "height width 3"], float]:
    """Draw one frame beside its picture; return the row of pictures and the PSNR."""
    size = drawn_size(sequence.recording, loss.long_side_px)
    target = read(sequence.recording, frame, size, loss.device)
    camera = loss.camera(sequence, frame)
    view = see(loss.cloud(sequence, frame, camera, target), camera, target.intrinsics, *size, loss.backend)
    error = (view.color.clamp(0, 1) - target.color).square().mean()
    near = (255 * (1 - view.depth / DEPTH_RANGE_M)).clamp(0, 255).byte().cpu().numpy()
    depth = cv2.applyColorMap(near, cv2.COLORMAP_VIRIDIS)[..., ::-1]
    agent = view.agent[..., None].expand(-1, -1, 3)
    shown = [(image.clamp(0, 1) * 255).byte().cpu().numpy() for image in (target.color, view.color, agent)]
    return np.hstack([shown[0], shown[1], depth, shown[2]]), float(-10 * torch.log10(error.clamp_min(1e-9)))
