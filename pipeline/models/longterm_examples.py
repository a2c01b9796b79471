"""What long-term motion is learned from: stretches of motion in scenes, cut into clips and single bodies.

`Lives` is the common form of reconstructed sessions (`reconstructed`) and of simulated ones (`Lives.load`); `cut` and
`encoded` make clips of it, `bodies` single bodies.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.files import meshes
from pipeline.models.bodies import Body, PoseSpace, load_body
from pipeline.models.clip_channels import Clips, Places, encode_clips, encode_places, pose_channels, root_channels
from pipeline.models.perception import world_from_ego
from pipeline.models.short_motions import STEPS, Moving, stretches
from pipeline.models.surroundings import Surroundings
from pipeline.models.trajectories import BehaviorData
from pipeline.space import rigid
from pipeline.space.signed_distance import SignedDistance


@dataclass(frozen=True)
class Lives:
    """Stretches of one body's motion at 30 fps, and the scenes they take place in."""

    body: Body
    stretches: tuple[Moving, ...]
    scene_of: tuple[int, ...]
    """per stretch, which scene"""
    scenes: tuple[Surroundings, ...]

    def some(self, wanted: Sequence[int]) -> "Lives":
        """Return some of the stretches, with the scenes that they need."""
        kept = sorted({self.scene_of[index] for index in wanted})
        return Lives(
            self.body,
            tuple(self.stretches[index] for index in wanted),
            tuple(kept.index(self.scene_of[index]) for index in wanted),
            tuple(self.scenes[index] for index in kept),
        )

    @property
    def distances(self) -> list[SignedDistance]:
        """The signed distance around each stretch."""
        return [self.scenes[index].distance for index in self.scene_of]


def reconstructed(reconstruction: Path, data: BehaviorData) -> tuple[Lives, list[str]]:
    """Read reconstructed sessions: all long enough stretches at 30 fps, and the recording that each is from."""
    body, mesh = load_body(reconstruction), meshes.read_ply(reconstruction / "scene.ply")
    found = [(video, part) for video, trajectory in data.trajectories.items() for part in stretches(trajectory)]
    roots = [trajectory.world_from_agent[trajectory.valid, :3, 3] for trajectory in data.trajectories.values()]
    scene = Surroundings.for_motion(mesh, np.concatenate(roots))
    return Lives(body, tuple(part for _, part in found), (0,) * len(found), (scene,)), [video for video, _ in found]


@dataclass(frozen=True)
class Cutting:
    """How examples are cut out of motion."""

    stride: int = 3
    """frames (30 fps) between the starts of clips"""
    resting: float = 0.3
    """share of the clips that end within 0.5 m of their start"""
    most_clips: int = 6000
    """clips at most, evenly left out beyond"""
    most_bodies: int = 3000
    """static bodies at most, evenly left out beyond"""
    level: float = 0.5
    """share of static bodies whose place is given without tilt and without its exact height, as a user gives it"""
    height_m: float = 0.03
    """spread of the heights of such places"""


MOVED_M = 0.5
"""A clip that ends further than this from its start travels (the paper keeps only those)."""


@dataclass(frozen=True)
class Bodies:
    """Single bodies, each described as a place and as what really stands there."""

    places: Places
    truth: Float[Tensor, "body channel"]
    """t, r in the place's heading frame, p"""
    scene: np.ndarray


@dataclass(frozen=True)
class Cuts:
    """Which short motions are taken: stretch and first frame of each."""

    stretch: Int[np.ndarray, "clip"]
    start: Int[np.ndarray, "clip"]

    def parts(self, lives: Lives) -> list[Moving]:
        """Return the motions."""
        pairs = zip(self.stretch, self.start, strict=True)
        return [lives.stretches[stretch][start : start + STEPS + 1] for stretch, start in pairs]


def cut(lives: Lives, cutting: Cutting, rng: np.random.Generator) -> Cuts:
    """Choose short motions: those that travel and a share of those that rest."""
    starts = [np.arange(0, len(stretch) - STEPS, cutting.stride) for stretch in lives.stretches]
    stretch, start = np.repeat(np.arange(len(starts)), list(map(len, starts))), np.concatenate(starts)
    roots = [each.world_from_agent[:, :3, 3] for each in lives.stretches]
    way = [np.linalg.norm(root[first + STEPS] - root[first], axis=1) for root, first in zip(roots, starts, strict=True)]
    moves = np.concatenate(way) > MOVED_M
    resting = np.flatnonzero(~moves)
    if moves.any():
        wanted = int(moves.sum() * cutting.resting / max(1 - cutting.resting, 1e-6))
        resting = rng.choice(resting, min(wanted, len(resting)), replace=False)
    chosen = np.sort(np.concatenate([np.flatnonzero(moves), resting]))
    chosen = chosen[:: max(1, int(np.ceil(len(chosen) / cutting.most_clips)))]
    return Cuts(stretch[chosen], start[chosen])


def encoded(lives: Lives, cuts: Cuts, poses: PoseSpace, points: int, rng: np.random.Generator) -> Clips:
    """Encode short motions; the poses of each stretch are encoded once."""
    p = [pose_channels(stretch.agent_from_bone, poses) for stretch in lives.stretches]
    pairs = list(zip(cuts.stretch, cuts.start, strict=True))
    root = np.stack([lives.stretches[stretch].world_from_agent[start : start + STEPS + 1] for stretch, start in pairs])
    pose = torch.stack([p[stretch][start : start + STEPS + 1] for stretch, start in pairs])
    return encode_clips(root, pose, np.asarray(lives.scene_of)[cuts.stretch], lives.scenes, points, rng)


def bodies(lives: Lives, cutting: Cutting, poses: PoseSpace, points: int, rng: np.random.Generator) -> Bodies:
    """Take single bodies out of the motion and describe their places, some as loosely as a user would."""
    stride = max(1, int(np.ceil(sum(map(len, lives.stretches)) / cutting.most_bodies)))
    frames = [stretch[::stride] for stretch in lives.stretches]
    root = np.concatenate([part.world_from_agent for part in frames])
    bones = np.concatenate([part.agent_from_bone for part in frames])
    scene = np.repeat(lives.scene_of, [len(part) for part in frames])
    given = root.copy()
    loose = rng.random(len(root)) < cutting.level
    given[loose] = world_from_ego(root[loose], "yaw")
    given[loose, 1, 3] += rng.normal(0, cutting.height_m, loose.sum())
    places = encode_places(given, scene, lives.scenes, points, rng)
    return Bodies(places, body_channels(places.world_from_place, Moving(root, bones), poses), scene)


def body_channels(world_from_place: Float[np.ndarray, "body 4 4"], moving: Moving, poses: PoseSpace) -> Float[Tensor, "body channel"]:
    """Return t, r and p of bodies in the frames of their places."""
    root = root_channels(rigid.inverse(world_from_place) @ moving.world_from_agent)
    return torch.cat([root, pose_channels(moving.agent_from_bone, poses)], dim=-1)


def fitted_poses(stretches: Sequence[Moving], rest: Float[np.ndarray, "bone 4 4"], components: int) -> PoseSpace:
    """Find the pose space of some motion."""
    return PoseSpace(rest, components).fit(np.concatenate([part.agent_from_bone[::3] for part in stretches]))
