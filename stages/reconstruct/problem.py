"""State of the reconstruction: measurements, fields, body, motion, and the video of each frame."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Generator, Tensor, nn

from pipeline.core.errors import InputError
from pipeline.data.motion import MotionTable
from pipeline.fields.fields import ArticulatedBody, Field
from pipeline.fields.limbs import KinematicTree, joined, shared_skin
from pipeline.geometry.meshes import Mesh
from pipeline.geometry.size import body_length_m
from stages.reconstruct.rays import RayStore

TRUSTED = 0.1
"""frames with a lower mask weight are left out of runs of consecutive frames"""
MAX_PRECISE = 100.0
"""prior precision of a camera registered with certainty, relative to one at even odds; losses alone err by a
millimeter and 0.05 degrees"""
PAUSE_STEPS = 2.5
"""a longer time between frames, in median times between frames, is a pause: a single lost frame is none"""
MAX_JOINTS = 4
"""maximum number of joints per bone"""
SOLE, SOLES = 0.07, 32
"""soles lie below this share of the animal's height; number of sole points"""
ON_SURFACE, AROUND = 4000, 40000
"""samples of the template's surface and of the space around it"""
AROUND_MARGIN = 0.417
"""margin around the template within which space is sampled, body lengths"""
NOISE_M = (0.01, 0.04)
"""half of the samples around the template lie this far from its surface, standard deviations"""


@dataclass(frozen=True)
class Problem:
    """State shared by all phases; tensors and modules are on one device."""

    store: RayStore
    scene: Field
    agent: Field
    body: ArticulatedBody
    motion: MotionTable
    video: Int[Tensor, "frame"]
    """index of each frame's video"""
    stretch: Int[Tensor, "frame"]
    """index of each frame's stretch of a video between pauses of the recording; priors of motion end there"""
    has_scene: Bool[Tensor, "frame"]
    """False for the turnaround: its world is the agent"""
    surface: "TemplateSurface"
    joints: "Joints"
    tree: KinematicTree
    agent_frames: Int[Tensor, "agent_frame"]
    """frames with a known root, a trusted mask and rays on the agent"""
    agent_rays: "RaysByFrame"
    trust: Float[Tensor, "frame"]
    """weight of each frame's mask, 0..1: less where the root was an outlier or little is in view"""
    root_precision: Float[Tensor, "frame"]
    """prior precision of each frame's root, relative to that of one registered to depth"""
    camera_precision: Float[Tensor, "knot"]
    """prior precision of each knot's camera correction, relative to that of a camera at even odds"""
    floor_m: float
    """height of the floor in the world"""

    @property
    def device(self) -> torch.device:
        """Device of the tensors and modules."""
        return self.scene.log_beta.device

    def modules(self) -> dict[str, nn.Module]:
        """Return the trainable modules by name."""
        return {"scene": self.scene, "agent": self.agent, "body": self.body, "motion": self.motion}

    def share(self, rank: int, size: int) -> "Problem":
        """Return the problem with the measurements of one process's videos, the longest dealt out first.

        Raises `InputError` RCN-002 where a process would get no video in which the agent is seen.
        """
        frames = torch.bincount(self.video)
        with_agent = torch.bincount(self.video[self.agent_frames], minlength=len(frames)) > 0
        both = with_agent & (torch.bincount(self.video[self.has_scene], minlength=len(frames)) > 0)
        order = sorted(range(len(frames)), key=lambda video: (not both[video], -int(frames[video])))
        if int(both.sum()) < size:
            what = f"{size} processes, but fewer recordings that show the agent in its home"
            raise InputError("RCN-002", what, "PROCESSES", "take fewer processes")
        own = torch.isin(self.video, torch.tensor(order[rank::size], device=self.device))
        scene = self.store.scene.at(torch.nonzero(own[self.store.scene.frame])[:, 0])
        agent = self.store.agent.at(torch.nonzero(own[self.store.agent.frame])[:, 0])
        return replace(
            self,
            store=RayStore(scene, agent, self.store.views),
            agent_frames=self.agent_frames[own[self.agent_frames]],
            agent_rays=RaysByFrame.of(agent.frame, len(self.video)),
        )

    def runs(self, length: int) -> Int[Tensor, "run"]:
        """Return first frames of runs of usable frames of one stretch; only trusted ones if there are any."""
        first = self.agent_frames.cpu()
        trusted = self.trust.cpu()[first] > TRUSTED
        first = first[trusted] if trusted.any() else first
        usable = torch.zeros(len(self.video) + length, dtype=torch.bool)
        usable[first] = True
        stretch = torch.cat([self.stretch.cpu(), torch.full((length,), -1)])
        good = [usable[first + k] & (stretch[first + k] == stretch[first]) for k in range(length)]
        return first[torch.stack(good).all(0)]


@dataclass(frozen=True)
class RaysByFrame:
    """Index ranges of each frame's rays on the agent."""

    start: Int[Tensor, "frame"]
    count: Int[Tensor, "frame"]

    @classmethod
    def of(cls, frame: Int[Tensor, "ray"], frames: int) -> "RaysByFrame":
        """Count rays, which are sorted by frame."""
        count = torch.bincount(frame, minlength=frames)
        return cls(count.cumsum(0) - count, count)

    def pick(
        self, frame: Int[Tensor, "frame"], number: int, generator: Generator
    ) -> Int[Tensor, "frame ray"]:
        """Choose rays of each frame at random, with repetition."""
        share = torch.rand(len(frame), number, generator=generator).to(frame.device)
        return self.start[frame][:, None] + (share * self.count[frame][:, None]).long()


@dataclass(frozen=True)
class Joints:
    """Joints between bones that share skin: pairs of bones and the point that both must move alike."""

    first: Int[Tensor, "joint"]
    second: Int[Tensor, "joint"]
    place: Float[Tensor, "joint 3"]
    """at rest, agent frame, meters"""

    @classmethod
    def of(cls, points: Float[Tensor, "point 3"], weights: Float[Tensor, "point bone"]) -> "Joints":
        """Join each bone with at least one and at most `MAX_JOINTS` bones with which it shares most skin."""
        share = shared_skin(weights)
        first, second = torch.nonzero(joined(share, MAX_JOINTS).triu(1), as_tuple=True)
        both = weights[:, first] * weights[:, second]
        return cls(first, second, both.T @ points / both.sum(0).clamp_min(1e-9)[:, None])


@dataclass(frozen=True)
class TemplateSurface:
    """The agent template: samples of its surface and of the space around it."""

    points: Float[Tensor, "point 3"]
    """on the surface, agent frame"""
    normal: Float[Tensor, "point 3"]
    around: Float[Tensor, "sample 3"]
    distance: Float[Tensor, "sample"]
    """signed, meters, of ``around``"""
    color: Float[Tensor, "sample 3"]
    """of the nearest surface point"""
    feature: Float[Tensor, "sample 16"]
    sole: Float[Tensor, "sole 3"]
    """some of the lowest of ``points``"""
    length_m: float
    """the unit of distances that depend on the body"""

    @classmethod
    def of(
        cls, mesh: Mesh, feature: Float[np.ndarray, "vertex 16"], rng: np.random.Generator
    ) -> "TemplateSurface":
        """Sample a mesh; distances are to the nearest of many surface samples, signed by their normals."""
        corner = mesh.vertices[mesh.faces].astype(np.float64)
        area = mesh.face_areas()
        face = rng.choice(len(mesh.faces), 8 * ON_SURFACE, p=area / area.sum())
        barycentric = rng.dirichlet(np.ones(3), len(face))
        points = np.einsum("pk,pkd->pd", barycentric, corner[face])
        normal = mesh.face_normals()[face]
        margin_m = AROUND_MARGIN * body_length_m(mesh)
        low, high = mesh.vertices.min(0) - margin_m, mesh.vertices.max(0) + margin_m
        half = AROUND // 2
        noise = rng.choice(NOISE_M, half)[:, None]
        near = points[rng.integers(len(points), size=half)] + rng.normal(size=(half, 3)) * noise
        around = np.concatenate([near, rng.uniform(low, high, (half, 3))])
        distances, near = map(np.asarray, KDTree(points).query(around, 8))
        offset = ((around[:, None] - points[near]) * normal[near]).sum(-1).mean(-1)
        distance = distances[:, 0] * np.where(offset < 0, -1, 1)
        vertex, weights = mesh.faces[face[near[:, 0]]], barycentric[near[:, 0]]
        vertex_color = mesh.color if mesh.color is not None else np.full_like(mesh.vertices, 128)
        color = np.einsum("pk,pkc->pc", weights, vertex_color[vertex] / 255)
        features = np.einsum("pk,pkc->pc", weights, feature[vertex].astype(np.float64))
        features /= np.maximum(np.linalg.norm(features, axis=-1, keepdims=True), 1e-6)
        points, normal = points[:ON_SURFACE], normal[:ON_SURFACE]
        height = points[:, 1] - points[:, 1].min()
        sole = points[height < SOLE * height.max()][:SOLES]
        parts = (points, normal, around, distance, color, features, sole)
        return cls(*(torch.from_numpy(array).float() for array in parts), length_m=body_length_m(mesh))


def prior_precision(motion: MotionTable, confidence: Float[np.ndarray, "frame"]) -> Float[Tensor, "knot"]:
    """Return the prior precision of each camera knot: 1 up to even odds, `MAX_PRECISE` if certain."""
    precision = 1 + (MAX_PRECISE - 1) * (2 * torch.from_numpy(confidence).float() - 1).clamp(0, 1).square()
    total, count = torch.zeros(2, len(motion.camera))
    for knot in (motion.knot, motion.knot + 1):
        total.index_add_(0, knot, precision)
        count.index_add_(0, knot, torch.ones_like(precision))
    return total / count


def pick(count: int, number: int, generator: Generator, device: torch.device) -> Int[Tensor, "sample"]:
    """Choose indices below ``count`` at random, with repetition."""
    return torch.randint(count, (number,), generator=generator).to(device)


def stretch_table(timestamp_s: Sequence[Float[np.ndarray, "frame"]]) -> Int[Tensor, "frame"]:
    """Return the index of each frame's stretch: a new one begins with a video and after a pause."""
    steps = [np.diff(times) for times in timestamp_s]
    begins = [np.append(True, step > PAUSE_STEPS * np.median(step)) for step in steps]
    return torch.from_numpy(np.cumsum(np.concatenate(begins)) - 1)


def frame_table(lengths: Sequence[int]) -> Int[Tensor, "frame"]:
    """Return the video's index of each frame."""
    return torch.repeat_interleave(torch.arange(len(lengths)), torch.tensor(lengths))
