"""Refine Gaussians and motion: render one frame per step; losses of color, depth, silhouette and flow.

Each of several processes (`pipeline.core.distributed`) renders its own frame, in proportionally fewer steps.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor, nn
from torch.nn import functional

from pipeline.core import distributed
from pipeline.core.training import FitRecord, fit
from pipeline.data.motion import Motion
from pipeline.fields.footprints import CUTOFF
from pipeline.fields.gaussians import Cloud, Splats, concatenate, render
from pipeline.fields.rasterize import Backend, in_view
from pipeline.geometry import cameras, rigid_torch
from stages.refine_gaussians.config import GaussianWeights
from stages.refine_gaussians.views import DrawnVideo, Target, flow_lattice, read

RATES = {"means": 5e-4, "rotation": 2e-3, "log_scale": 1e-2, "opacity_logit": 3e-2, "band0": 1e-2}
"""learning rates of Adam: meters, quaternions, log meters, logits, spherical harmonics"""
EXPOSURE_RATE, MOTION_RATE = 2e-3, 3e-4
"""learning rates of exposures, and of root and bones, meters and radians"""
BETA2 = 0.99
"""Adam's second beta for motion, which has no momentum: frames not in the step must not move"""
LAST_RATE = 0.1
"""final learning rate as a share of the initial one"""
DEPTH_UNIT_M, MOTION_UNIT = 0.2, 0.1
"""units of the depth loss, and of the motion loss (meters and radians)"""
MAX_FLOW_PX = 100.0
"""rendered flow is clamped to this, in rendered pixels: points beside the camera project anywhere"""
MAX_FLOW_LOSS, MIN_COVERAGE = 4.0, 0.5
"""saturation of flow errors, and coverage from which a pixel has a flow loss"""


class MotionDeltas(nn.Module):
    """Corrections of roots and bones of all frames, as twists."""

    def __init__(self, frames: int, bones: int):
        super().__init__()
        self.root = nn.Parameter(torch.zeros(frames, 6))
        self.bone = nn.Parameter(torch.zeros(frames, bones, 6))

    def apply(
        self,
        world_from_agent: Float[Tensor, "*batch 4 4"],
        agent_from_bone: Float[Tensor, "*batch bone 4 4"],
        frame: int | Int[Tensor, "*batch"],
    ) -> tuple[Float[Tensor, "*batch 4 4"], Float[Tensor, "*batch bone 4 4"]]:
        """Return the corrected root and bones of frames."""
        root, bone = (rigid_torch.se3_exp(table[frame]) for table in (self.root, self.bone))
        return world_from_agent @ root, agent_from_bone @ bone


class FrameLoss:
    """The loss of one random frame, rendered over a random background color to penalize holes."""

    def __init__(
        self,
        splats: Splats,
        deltas: MotionDeltas,
        videos: Sequence[DrawnVideo],
        weights: GaussianWeights,
        long_side_px: int,
        backend: Backend,
    ):
        self.splats, self.deltas, self.videos = splats, deltas, videos
        self.weights, self.long_side_px = weights, long_side_px
        self.backend: Backend = backend
        self.device = str(splats.appearance.device)
        self.frames = [(video, frame) for video in videos for frame in video.usable_frames()]

    def __call__(self, step: int, generator: Generator) -> dict[str, Tensor]:
        video, frame = self.frames[int(torch.randint(len(self.frames), (1,), generator=generator))]
        size = video.drawn_size(self.long_side_px)
        target = read(video, frame, size, self.device)
        camera = self.camera(video, frame)
        cloud = self.cloud(video, frame, camera, target)
        flow = self._projected_flow(video, frame, target, cloud)
        view = render(cloud, camera, target.intrinsics, *size, backend=self.backend, extra=flow)
        room = torch.ones_like(target.agent) if cloud.agent.any() else ~target.agent
        rendered = room if video.appearance is not None else target.agent
        measured = (target.depth > 0) & rendered
        weights, terms = self.weights, {}
        background = torch.rand(3, generator=generator).to(self.device)
        color = view.color + (1 - view.coverage)[..., None] * background
        terms["color"] = weights.color * (color - target.color).abs().mean(-1)[rendered & target.known]
        depth_error = ((view.depth - target.depth).abs() / DEPTH_UNIT_M).clamp_max(1)
        terms["depth"] = weights.depth * depth_error[measured]
        terms["silhouette"] = weights.silhouette * (view.agent - target.agent.float()).abs()[target.known]
        if flow is not None:
            errors = self._flow_errors(video, target, view.extra, view.coverage, rendered)
            terms["flow"] = weights.flow * errors
        elif distributed.size() > 1:  # all processes have the same terms
            terms["flow"] = torch.zeros(1, device=self.device)
        index = video.first + frame
        correction = torch.cat([self.deltas.root[index : index + 1], self.deltas.bone[index]])
        terms["motion"] = weights.motion * (correction / MOTION_UNIT).square()
        return {name: values.mean() if values.numel() else values.sum() for name, values in terms.items()}

    def cloud(
        self, video: DrawnVideo, frame: int, camera_from_world: Float[Tensor, "4 4"], target: Target
    ) -> Cloud:
        """Return the Gaussians in view of one frame's camera."""
        parts = []
        if video.appearance is not None:
            scene = self.splats.scene
            height, width = target.depth.shape
            camera = camera_from_world, target.intrinsics, height, width
            seen = in_view(scene.means, scene.log_scale, *camera)
            parts.append(self.splats.place_scene(video.appearance, seen))
        if video.appearance is None or self._shows_agent(video, frame, camera_from_world, target):
            parts.append(self.splats.place_agent(*self._pose(video, frame), video.appearance))
        return concatenate(*parts)

    def _shows_agent(self, video: DrawnVideo, frame: int, camera_from_world: Tensor, target: Target) -> bool:
        """Return whether the agent's pose is known and its bounding sphere is in view."""
        if not video.motion.agent_known[frame]:
            return False
        root = torch.from_numpy(video.motion.world_from_agent[frame]).float().to(self.device)
        radius = self.splats.agent.means.detach().norm(dim=-1).amax() / CUTOFF
        center = root[None, :3, 3]
        size = radius.log().expand(1, 3)
        return len(in_view(center, size, camera_from_world, target.intrinsics, *target.depth.shape)) > 0

    def _pose(self, video: DrawnVideo, frame: int) -> tuple[Tensor, Tensor]:
        root = torch.from_numpy(video.motion.world_from_agent[frame]).float().to(self.device)
        bones = torch.from_numpy(video.motion.agent_from_bone[frame]).float().to(self.device)
        return self.deltas.apply(root, bones, video.first + frame)

    def camera(self, video: DrawnVideo, frame: int) -> Float[Tensor, "4 4"]:
        """Return ``camera_from_world`` of one frame."""
        camera_from_world = np.linalg.inv(video.motion.world_from_camera[frame])
        return torch.from_numpy(camera_from_world).float().to(self.device)

    def _projected_flow(self, video: DrawnVideo, frame: int, target: Target, cloud: Cloud) -> Tensor | None:
        """Return the flow of each Gaussian to the next frame, in rendered pixels; None if it is unknown."""
        motion, later = video.motion, frame + 1
        if target.flow_px is None or later >= len(motion.timestamp_s):
            return None
        if not np.isfinite(motion.world_from_camera[later]).all():
            return None
        means = cloud.means
        if cloud.agent.any():
            if not motion.agent_known[later]:
                return None
            moved = self.splats.place_agent(*self._pose(video, later), video.appearance).means
            means = torch.cat([cloud.means[: len(cloud.means) - len(moved)], moved])
        now, then = (
            cameras.project(rigid_torch.apply(self.camera(video, at), points), target.intrinsics)[0]
            for at, points in ((frame, cloud.means), (later, means))
        )
        return (then - now).clamp(-MAX_FLOW_PX, MAX_FLOW_PX)

    def _flow_errors(
        self, video: DrawnVideo, target: Target, flow: Tensor, coverage: Tensor, rendered: Tensor
    ) -> Tensor:
        assert target.flow_px is not None and target.flow_confidence is not None, "a frame without flow"
        rows, columns = target.flow_confidence.shape
        height, width = target.color.shape[:2]
        lattice = flow_lattice(rows, columns, video.clip.color_size, (height, width))
        row, column = (index.to(self.device) for index in lattice)
        found = flow[row, column] / coverage[row, column].clamp_min(0.1)[..., None]
        error = functional.huber_loss(found, target.flow_px, reduction="none", delta=1.0).sum(-1)
        valid = (coverage[row, column] > MIN_COVERAGE) & rendered[row, column]
        return (error.clamp_max(MAX_FLOW_LOSS) * target.flow_confidence)[valid]


def refine(loss: FrameLoss, steps: int, seed: int, resume: Path | None, save_every: int) -> FitRecord:
    """Optimize Gaussians, exposures and motion in place, on ``steps`` frames in total."""
    splats, deltas = loss.splats, loss.deltas
    groups = [{"params": [splats.appearance], "lr": EXPOSURE_RATE}]
    for gaussians in (splats.scene, splats.agent):
        groups += [{"params": [getattr(gaussians, name)], "lr": rate} for name, rate in RATES.items()]
    groups.append({"params": list(deltas.parameters()), "lr": MOTION_RATE, "betas": (0.0, BETA2)})
    return fit(
        modules={"splats": splats, "motion": deltas},
        optimizer=torch.optim.Adam(groups, lr=1.0, fused=True),
        loss=loss,
        steps=-(-steps // distributed.size()),
        seed=seed,
        resume=resume,
        save_every=save_every,
        schedule=lambda progress: LAST_RATE**progress,
        label="gaussians",
        clip_norm=math.inf,
        shared=True,
    )


@torch.no_grad()
def corrected(motion: Motion, deltas: MotionDeltas, first: int) -> Motion:
    """Return one video's motion with its corrections applied."""
    frame = torch.arange(first, first + len(motion.timestamp_s))
    device = deltas.root.device
    poses = (motion.world_from_agent, motion.agent_from_bone)
    root, bones = (torch.from_numpy(array.astype(np.float64)).to(device) for array in poses)
    root, bones = deltas.double().apply(root, bones, frame.to(device))
    deltas.float()
    return replace(motion, world_from_agent=root.cpu().numpy(), agent_from_bone=bones.cpu().numpy())
