"""Training data of long-term motion: stretches of motion in scenes, cut into clips and static bodies.

`MotionDataset` holds reconstructed sessions (`reconstructed_split`) or simulated ones
(`simulated_lives.load`). `select_clips` and `encode_selection` cut clips from it, `sample_static_bodies`
samples static bodies.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.behavior.perception import world_from_ego
from pipeline.behavior.trajectories import BehaviorData
from pipeline.geometry import rigid, subsampling
from pipeline.geometry.signed_distance import SignedDistance
from pipeline.longterm.bodies import PoseSpace, SkinnedBody, load_body
from pipeline.longterm.clip_channels import Clips, EncodedPlaces, encode_clips, encode_places, root_channels
from pipeline.longterm.short_motions import STEPS, BodyMotion, stretches
from pipeline.longterm.surroundings import MotionScene


@dataclass(frozen=True)
class MotionDataset:
    """Stretches of one body's motion at 30 fps, and the scenes they take place in."""

    body: SkinnedBody
    stretches: tuple[BodyMotion, ...]
    scene_of: tuple[int, ...]
    """index of each stretch's scene"""
    scenes: tuple[MotionScene, ...]

    def subset(self, chosen: Sequence[int] | Int[np.ndarray, "some"]) -> "MotionDataset":
        """Return some of the stretches, with their scenes."""
        needed = sorted({self.scene_of[index] for index in chosen})
        stretches = tuple(self.stretches[index] for index in chosen)
        scene_of = tuple(needed.index(self.scene_of[index]) for index in chosen)
        return MotionDataset(self.body, stretches, scene_of, tuple(self.scenes[index] for index in needed))

    @property
    def distances(self) -> list[SignedDistance]:
        """The signed distance around each stretch."""
        return [self.scenes[index].distance for index in self.scene_of]


@dataclass(frozen=True)
class DatasetSplit:
    """Training motion and held-out motion, if any."""

    train: MotionDataset
    held_out: MotionDataset | None
    kinds: tuple[str, ...] = ()
    """per held-out stretch: held_out, unseen or test"""

    @classmethod
    def of(cls, dataset: MotionDataset, kinds: Sequence[str]) -> "DatasetSplit":
        """Split a dataset by the kind of each stretch: `train`, or any other kind for held-out motion."""
        is_train = np.array(kinds) == "train"
        train, rest = np.flatnonzero(is_train), np.flatnonzero(~is_train)
        held_out = dataset.subset(rest) if len(rest) else None
        return cls(dataset.subset(train), held_out, tuple(kinds[index] for index in rest.tolist()))


def reconstructed_split(reconstruction: Path, data: BehaviorData) -> DatasetSplit:
    """Read stretches of two seconds or more of reconstructed sessions; behavior test videos are held out."""
    found = [
        (video, part) for video, trajectory in data.trajectories.items() for part in stretches(trajectory)
    ]
    scene = MotionScene.reconstructed(reconstruction, data.trajectories.values())
    parts = tuple(part for _, part in found)
    dataset = MotionDataset(load_body(reconstruction), parts, (0,) * len(found), (scene,))
    return DatasetSplit.of(dataset, ["train" if video in data.training else "test" for video, _ in found])


STRIDE = 3
"""Frames (30 fps) between the starts of clips."""
RESTING_SHARE = 0.3
"""Share of clips that end within `MOVED_M` of their start: without any, a model never learns to rest."""
MAX_CLIPS = 6000
"""Maximum number of clips; beyond that they are subsampled evenly."""
LEVEL_SHARE = 0.5
"""Share of static bodies conditioned on a place without tilt and exact height, as a user specifies it."""
LEVEL_HEIGHT_M = 0.03
"""Standard deviation of the heights of such places."""
POSE_STRIDE = 3
"""Stride of the frames that the pose space is fitted to: neighbors at 30 fps hardly differ."""
MOVED_M = 0.5
"""A clip that ends further than this from its start travels (the paper keeps only those)."""


@dataclass(frozen=True)
class StaticBodies:
    """Static bodies: the place each is conditioned on, and the true body there."""

    places: EncodedPlaces
    truth: Float[Tensor, "body channel"]
    """t, r in the place's heading frame, p"""
    scene: np.ndarray


@dataclass(frozen=True)
class ClipSelection:
    """Stretch and first frame of each selected clip."""

    stretch: Int[np.ndarray, "clip"]
    start: Int[np.ndarray, "clip"]

    def parts(self, dataset: MotionDataset) -> list[BodyMotion]:
        """Return the motions of the clips."""
        pairs = zip(self.stretch, self.start, strict=True)
        return [dataset.stretches[stretch][start : start + STEPS + 1] for stretch, start in pairs]


def select_clips(
    dataset: MotionDataset,
    rng: np.random.Generator,
    *,
    stride: int = STRIDE,
    resting: float = RESTING_SHARE,
    most: int = MAX_CLIPS,
) -> ClipSelection:
    """Select clips: all that travel, and a share ``resting`` of clips that rest, ``most`` at most."""
    starts = [np.arange(0, len(stretch) - STEPS, stride) for stretch in dataset.stretches]
    stretch, start = np.repeat(np.arange(len(starts)), list(map(len, starts))), np.concatenate(starts)
    roots = (each.world_from_agent[:, :3, 3] for each in dataset.stretches)
    both = zip(roots, starts, strict=True)
    displacement = [np.linalg.norm(root[first + STEPS] - root[first], axis=1) for root, first in both]
    moves = np.concatenate(displacement) > MOVED_M
    still = np.flatnonzero(~moves)
    if moves.any():
        count = int(moves.sum() * resting / max(1 - resting, 1e-6))
        still = rng.choice(still, min(count, len(still)), replace=False)
    chosen = np.sort(np.concatenate([np.flatnonzero(moves), still]))
    chosen = chosen[subsampling.evenly(len(chosen), most)]
    return ClipSelection(stretch[chosen], start[chosen])


def encode_selection(
    dataset: MotionDataset, selection: ClipSelection, poses: PoseSpace, points: int, rng: np.random.Generator
) -> Clips:
    """Encode clips as network channels; the poses of each stretch are encoded once."""
    p = [poses.encode(poses.channels(stretch.agent_from_bone)) for stretch in dataset.stretches]
    pairs = zip(selection.stretch, selection.start, strict=True)
    root = np.stack([part.world_from_agent for part in selection.parts(dataset)])
    pose = torch.stack([p[stretch][start : start + STEPS + 1] for stretch, start in pairs])
    scene = np.asarray(dataset.scene_of)[selection.stretch]
    return encode_clips(root, pose, scene, dataset.scenes, points, rng)


def sample_static_bodies(
    dataset: MotionDataset, poses: PoseSpace, points: int, rng: np.random.Generator, *, most: int
) -> StaticBodies:
    """Sample static bodies from the motion; `LEVEL_SHARE` of their places are as imprecise as a user's."""
    stride = max(1, int(np.ceil(sum(map(len, dataset.stretches)) / most)))
    frames = [stretch[::stride] for stretch in dataset.stretches]
    root = np.concatenate([part.world_from_agent for part in frames])
    bones = np.concatenate([part.agent_from_bone for part in frames])
    scene = np.repeat(dataset.scene_of, [len(part) for part in frames])
    given = root.copy()
    loose = rng.random(len(root)) < LEVEL_SHARE
    given[loose] = world_from_ego(root[loose], "yaw")
    given[loose, 1, 3] += rng.normal(0, LEVEL_HEIGHT_M, loose.sum())
    places = encode_places(given, scene, dataset.scenes, points, rng)
    t_and_r = root_channels(rigid.inverse(places.world_from_place) @ root)
    return StaticBodies(places, torch.cat([t_and_r, poses.encode(poses.channels(bones))], dim=-1), scene)


def fit_pose_space(
    stretches: Sequence[BodyMotion], rest: Float[np.ndarray, "bone 4 4"], components: int
) -> PoseSpace:
    """Fit a pose space to motion."""
    bones = np.concatenate([part.agent_from_bone[::POSE_STRIDE] for part in stretches])
    return PoseSpace(rest, components).fit(bones)
