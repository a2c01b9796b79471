"""Motion at 30 fps; long-term motion is learned and synthesized in two-second clips of it.

`BodyMotion` is a stretch of motion of one body. `resample_motion` resamples a trajectory to 30 fps (cubic
spline on positions, slerp on rotations), `stretches` splits it at missing frames. `smooth_seams` smooths the
seams that `concatenate_motions` leaves, `limit_turn_rate` slows turns down to a rate that an animal can make.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Real
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from pipeline.behavior.trajectories import Trajectory
from pipeline.geometry import rigid
from pipeline.geometry.subsampling import runs

RATE_HZ = 30
STEPS = 60
"""k of the paper: a short motion has k + 1 frames, the first and the last of which are given"""
SEAM_REACH = 6
"""Frames on both sides of a seam that are interpolated."""
EARLY, LATE = (0.2, 0.55), (0.45, 0.8)
"""phases of a jump, as shares of its duration: first up (or across), then across (or down)"""


@dataclass(frozen=True)
class BodyMotion:
    """Consecutive frames of one body at one rate."""

    world_from_agent: Float[np.ndarray, "frame 4 4"]
    agent_from_bone: Float[np.ndarray, "frame bone 4 4"]

    def __len__(self) -> int:
        return len(self.world_from_agent)

    def __getitem__(self, frames: slice | np.ndarray) -> "BodyMotion":
        """Return some of the frames."""
        return BodyMotion(self.world_from_agent[frames], self.agent_from_bone[frames])

    def tensors(self) -> tuple[Float[Tensor, "frame 4 4"], Float[Tensor, "frame bone 4 4"]]:
        """Return root and bones in torch, single precision."""
        return torch.from_numpy(self.world_from_agent).float(), torch.from_numpy(self.agent_from_bone).float()


def concatenate_motions(parts: Sequence[BodyMotion]) -> BodyMotion:
    """Concatenate consecutive stretches; the frame that two of them share is kept once."""
    parts = [parts[0], *(part[1:] for part in parts[1:])]
    roots = np.concatenate([part.world_from_agent for part in parts])
    return BodyMotion(roots, np.concatenate([part.agent_from_bone for part in parts]))


def jump_between_levels(motion: BodyMotion, hop_m: float = 0.08) -> BodyMotion:
    """Turn a motion between two levels into a jump: up before across, or across before down."""
    share, (start, end) = np.linspace(0, 1, len(motion)), motion.world_from_agent[[0, -1], :3, 3]
    early, late = (_smoothstep(share, *span) for span in (EARLY, LATE))
    upward, across = (early, late) if end[1] > start[1] else (late, early)
    roots = motion.world_from_agent.copy()
    roots[:, :3, 3] = start + np.stack([across, upward, across], axis=-1) * (end - start)
    roots[:, 1, 3] += (
        hop_m * _smoothstep(share, EARLY[0], LATE[0]) * (1 - _smoothstep(share, EARLY[1], LATE[1]))
    )
    return BodyMotion(roots, motion.agent_from_bone)


def _smoothstep(share: Float[np.ndarray, "frame"], low: float, high: float) -> Float[np.ndarray, "frame"]:
    part = np.clip((share - low) / (high - low), 0, 1)
    return part * part * (3 - 2 * part)


def smooth_seams(motion: BodyMotion) -> BodyMotion:
    """Interpolate over the `SEAM_REACH` frames on both sides of the seams of short motions.

    Each clip ends in a given body that was sampled independently, and would snap to it in its last frames.
    """
    frame, last = np.arange(len(motion)), (len(motion) - 1) // STEPS - 1
    if last < 1:
        return motion
    seam = np.clip(np.round(frame / STEPS), 1, last) * STEPS
    offset = np.abs(frame - seam)
    anchors = np.flatnonzero((offset == 0) | (offset > SEAM_REACH))
    return _interpolate(anchors, motion[anchors], frame)


def limit_turn_rate(motion: BodyMotion, max_rad: float) -> BodyMotion:
    """Spread root turns faster than ``max_rad`` per frame over neighboring frames; positions and poses stay.

    For half a turn within two seconds, networks with 6D rotations flip within a frame or two.
    """
    rotation = Rotation.from_matrix(motion.world_from_agent[:, :3, :3])
    turned = np.concatenate([[0.0], np.cumsum((rotation[:-1].inv() * rotation[1:]).magnitude())])
    frame = np.arange(len(motion))
    ramp = max(max_rad, turned[-1] / max(len(motion) - 1, 1)) * frame
    late = np.minimum.accumulate(turned - ramp) + ramp
    early = np.maximum.accumulate((turned - ramp)[::-1])[::-1] + ramp
    limited = np.clip((late + early) / 2, turned[-1] - ramp[::-1], ramp)
    roots = motion.world_from_agent.copy()
    roots[:, :3, :3] = Slerp(frame, rotation)(np.interp(limited, turned + 1e-9 * frame, frame)).as_matrix()
    return BodyMotion(roots, motion.agent_from_bone)


def resample_motion(timestamp_s: Float[np.ndarray, "frame"], motion: BodyMotion) -> BodyMotion:
    """Resample root and bones to 30 fps: cubic spline on positions, slerp on rotations."""
    count = int(np.floor((timestamp_s[-1] - timestamp_s[0]) * RATE_HZ + 1e-6)) + 1
    query_s = np.minimum(timestamp_s[0] + np.arange(count) / RATE_HZ, timestamp_s[-1])
    return _interpolate(timestamp_s, motion, query_s)


def stretches(trajectory: Trajectory) -> list[BodyMotion]:
    """Return the uninterrupted stretches of a trajectory that hold a whole short motion, at 30 fps."""
    found = []
    for start, end in runs(trajectory.valid):
        when = trajectory.timestamp_s[start:end]
        if len(when) > 2 and when[-1] - when[0] >= STEPS / RATE_HZ - 1e-6:
            motion = BodyMotion(trajectory.world_from_agent[start:end], trajectory.agent_from_bone[start:end])
            found.append(resample_motion(when, motion))
    return found


def _interpolate(
    times: Real[np.ndarray, "frame"], motion: BodyMotion, query: Real[np.ndarray, "sample"]
) -> BodyMotion:
    def between(a_from_b: Float[np.ndarray, "frame 4 4"]) -> Float[np.ndarray, "sample 4 4"]:
        rotation = Slerp(times, Rotation.from_matrix(np.asarray(a_from_b[:, :3, :3], np.float64)))
        return rigid.make(rotation(query).as_matrix(), CubicSpline(times, a_from_b[:, :3, 3])(query))

    bones = [between(bone) for bone in np.moveaxis(motion.agent_from_bone, 1, 0)]
    return BodyMotion(between(motion.world_from_agent), np.stack(bones, axis=1))
