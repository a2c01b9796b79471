"""Training windows as tensors in the ego frame, and the augmented batches drawn from them.

Augmentation rotates the ego frame about its up axis, mirrors left and right (which hides bones, as their
symmetry is unknown), shifts the observer and adds noise to the past: five minutes of video must suffice.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.behavior.config import Encoding
from pipeline.behavior.diffusion import STANDARD
from pipeline.behavior.encoders import other_channels_torch, with_anticipated
from pipeline.behavior.model import ROOT_CHANNELS, Architecture, Scaling, channels_from_bones
from pipeline.behavior.path_encoding import GOAL_POWER_OF, velocity_channels_from_path, with_powered_length
from pipeline.behavior.perception import POSITION, PerceptionEnsemble, world_from_ego
from pipeline.behavior.trajectories import RATE_HZ, anticipated_frames
from pipeline.environments.homes import Habitat
from pipeline.geometry import rigid, rigid_torch
from stages.train_behavior.config import AugmentationConfig
from stages.train_behavior.homes import windows_of_all
from stages.train_behavior.scene_sampler import SceneSampler

YAW_JITTER_RAD = 0.3
"""maximum rotation of samples that are not rotated by an arbitrary angle"""
OBSERVER_SHIFT_M = 0.05
"""standard deviation of a shift of the observer's whole past: the error of reconstructed cameras"""
POSTURE_TILT_RAD, POSTURE_BEND = 0.15, 0.3
"""standard deviations of a posture's offset: tilt of the root; bones, in their own standard deviations"""
APPROACH_DISTANCE_M, APPROACH_SPEED_M_S = 2.4, 0.4
"""maximum distance and minimum speed of an approaching observer"""
BIN_M, MAX_REPEATS = 0.2, 8
"""width of the distance bins that approaches are balanced over, and maximum repetitions of a window"""
MIN_PATH_STD_M, MIN_WAY_STD = 0.02, 0.05
"""minimum scales of positions of paths (meters), and of goals, strides and past positions"""
MIN_ROTATION_STD, MIN_BONE_STD = 0.1, (0.05, 0.05, 0.05, 0.01, 0.01, 0.01)
"""minimum scales of the root's rotation and of the six channels of a bone, for animals that only rest"""
MAX_STATISTICS_WINDOWS = 8192
"""Maximum number of windows for means and standard deviations."""


@dataclass(frozen=True)
class EgoTracks:
    """Motion of animal and others in some windows, each in its own ego frame."""

    root: Float[Tensor, "window frame 3"]
    rotation: Float[Tensor, "window frame 3 3"]
    ego_from_observer: Float[Tensor, "window past_frame 4 4"]
    ahead: Float[Tensor, "window anticipated_frame 3"]
    """where the observer will be"""
    companions: Float[Tensor, "window companion past_frame 4"]


@dataclass(frozen=True)
class TrainingWindows:
    """All training windows: concatenated frames, and the frame indices of each window."""

    world_from_agent: Float[Tensor, "frame 4 4"]
    world_from_observer: Float[Tensor, "frame 4 4"]
    companions_world: Float[Tensor, "window companion past_frame 4"]
    bones: Float[Tensor, "frame channel"]
    world_from_ego: Float[Tensor, "window 4 4"]
    frame: Int[Tensor, "window window_frame"]
    scene: Int[Tensor, "window"]
    """index of the window's feature volume"""
    bones_known: Bool[Tensor, "window"]
    """whether it is of the animal's own build, whose bones the model has"""
    approached: Int[Tensor, "some"]
    """windows with an approaching observer, repeated to balance distances"""
    rate_hz: float = RATE_HZ
    """frames per second"""
    encoding: Encoding = "strides"
    """of goals and paths"""

    @property
    def past(self) -> int:
        """Number of past frames of a window."""
        return self.companions_world.shape[2]

    def __len__(self) -> int:
        return len(self.frame)

    def tracks(self, index: Int[Tensor, "some"]) -> EgoTracks:
        """Transform some windows to the ego frames of their current times."""
        ego_from_world = rigid_torch.inverse(self.world_from_ego[index])
        ego_from_agent = ego_from_world[:, None] @ self.world_from_agent[self.frame[index]]
        ego_from_observer = ego_from_world[:, None] @ self.world_from_observer[self.frame[index, : self.past]]
        later = self.past - 1 + anticipated_frames(self.frame.shape[1] - self.past)
        ahead = self.world_from_observer[self.frame[index][:, later]][..., :3, 3]
        companions = self.companions_world[index]
        place = rigid_torch.apply(ego_from_world[:, None], companions[..., :3])
        companions = torch.cat([place, companions[..., 3:]], dim=-1)
        root, rotation = ego_from_agent[..., :3, 3], ego_from_agent[..., :3, :3]
        ahead = rigid_torch.apply(ego_from_world, ahead)
        return EgoTracks(root, rotation, ego_from_observer, ahead, companions)


@dataclass(frozen=True)
class WindowStatistics:
    """Means and standard deviations of the training windows."""

    scaling: Scaling
    """of goal, path and body"""
    past_mean: Float[Tensor, "channel"]
    """per frame: root position, root rotation, bones"""
    past_std: Float[Tensor, "channel"]


@dataclass(frozen=True)
class TrainingBatch:
    """One augmented batch: inputs of perception, and clean targets in scaled units."""

    scene: Float[Tensor, "batch channel x y z"]
    others: Float[Tensor, "batch other frame 10"]
    """past frames, then anticipated ones, with where the observer will be"""
    past: Float[Tensor, "batch past"]
    held: Float[Tensor, "batch held_frame held_channel"]
    """root and bones of the frames that give velocity and posture, without noise"""
    bones_keep: Float[Tensor, "batch"]
    bones_known: Bool[Tensor, "batch"]
    """not mirrored, and of the animal's own build"""
    oversampled: Bool[Tensor, "batch"]
    """drawn for an approaching observer, who is never dropped then: the null must keep unbiased data"""
    goal: Float[Tensor, "batch 3"]
    track: Float[Tensor, "batch 3 frame"]
    """positions of all frames, encoded as goals"""
    path: Float[Tensor, "batch path_channel frame"]
    """strides or positions"""
    places: Float[Tensor, "batch 3 frame"]
    """the path as it controls the body"""
    body: Float[Tensor, "batch body_channel frame"]

    def to(self, device: torch.device) -> "TrainingBatch":
        """Return the batch on a device."""
        return TrainingBatch(*(value.to(device) for value in vars(self).values()))


def windows_from_data(homes: Habitat, architecture: Architecture) -> TrainingWindows:
    """Concatenate the frames of all recordings and index the training windows."""
    data, index = homes.data, windows_of_all(homes)
    tracks = [data.trajectories[video] for video in data.videos]
    agent = np.concatenate([track.world_from_agent for track in tracks])
    observer = np.concatenate([track.world_from_camera for track in tracks])
    rest = data.agent_from_bone_rest
    bones = np.concatenate([channels_from_bones(track.agent_from_bone, rest) for track in tracks])
    first = np.cumsum([0, *(len(track.timestamp_s) for track in tracks[:-1])])
    rows = (first[data.video[index]] + data.start[index])[:, None] + np.arange(data.past + data.future)
    frame = world_from_ego(agent[rows[:, data.past - 1]], architecture.ego)
    number = homes.scenes.number(data.video[index], len(index))
    now = agent[rows[:, data.past - 1], :3, 3]
    companions = data.nearest_companions(index, now)
    arrays = agent, observer, companions, bones, frame
    tables = (torch.from_numpy(array.astype(np.float32)) for array in arrays)
    approaching = approached(now, observer[rows[:, : data.past], :3, 3], data.rate_hz)
    approaching = approaching[:0] if architecture.ablated_input == "observer" else approaching
    known = homes.home_of_window[index] == 0
    indices = (torch.from_numpy(index) for index in (rows, number, known, approaching))
    return TrainingWindows(*tables, *indices, rate_hz=data.rate_hz, encoding=architecture.encoding)


def approached(
    agent: Float[np.ndarray, "window 3"],
    observer: Float[np.ndarray, "window past_frame 3"],
    rate_hz: float = RATE_HZ,
) -> Int[np.ndarray, "some"]:
    """Return the windows in which an observer within `APPROACH_DISTANCE_M` approaches at least at
    `APPROACH_SPEED_M_S`, repeated to balance the distances.
    """
    away = (agent[:, None] - observer)[..., [0, 2]]
    distance = np.linalg.norm(away[:, -1], axis=-1)
    velocity = (observer[:, -1] - observer[:, 0])[:, [0, 2]] * (rate_hz / (observer.shape[1] - 1))
    approaches = (velocity * away[:, -1]).sum(-1) > APPROACH_SPEED_M_S * distance
    approaching = np.flatnonzero((distance < APPROACH_DISTANCE_M) & approaches)
    bins = (distance[approaching] / BIN_M).astype(int)
    most = np.bincount(bins).max(initial=0)
    parts = [approaching[:0], *(approaching[bins == number] for number in np.unique(bins))]
    counts = (np.arange(min(most, MAX_REPEATS * len(part))) for part in parts)
    both = zip(parts, counts, strict=True)
    return np.concatenate([part[count * len(part) // max(len(count), 1)] for part, count in both])


def largest_turn_rad(augmentation: AugmentationConfig) -> float:
    """Return the maximum rotation of the ego frame about its up axis, either vectors, radians."""
    return math.pi if augmentation.turn > 0 else 0.0


def statistics_from_windows(windows: TrainingWindows, turn_rad: float) -> WindowStatistics:
    """Fit the scales of goal, path (per frame, horizontal axes pooled), body and past to some windows.

    Root rotations are scaled for ego frames rotated by up to ``turn_rad`` either way. Past bodies are scaled
    as future ones, except for the heading.
    """
    some = torch.arange(0, len(windows), -(-len(windows) // MAX_STATISTICS_WINDOWS))
    tracks, rows, known = windows.tracks(some), windows.frame[some], windows.bones_known[some]
    past, rate_hz = windows.past, windows.rate_hz
    future = tracks.root[:, past:].double().numpy()
    level = np.sqrt((future[..., ::2] ** 2).mean((0, 2))).clip(MIN_PATH_STD_M)
    height = np.sqrt((future[..., 1] ** 2).mean(0)).clip(MIN_PATH_STD_M)
    path_std = np.stack([level, height, level])
    bones = windows.bones[rows[known, past:].unique()]
    mean, std = body_statistics(tracks.rotation[:, past:], bones, turn_rad)
    # The smallest scale that clips no heading: residual sampling noise shakes a body.
    heading_std = (1 + np.abs(mean[:3]).max()) / STANDARD.clip
    body_std = np.concatenate([np.full(3, heading_std), std[3:]])
    strides = velocity_channels_from_path(tracks.root[:, past:], tracks.root[:, past - 1], rate_hz)
    velocity_std = np.array([[*_axis_rms(strides[..., :3].double().numpy().reshape(-1, 3)), 1.0]])
    goal_std = _axis_rms(with_powered_length(future[:, -1], GOAL_POWER_OF[windows.encoding]))
    scaling = Scaling(goal_std, velocity_std, path_std, mean, body_std, rate_hz, windows.encoding)
    position = tracks.root[:, :past].std().clip(MIN_WAY_STD).expand(3)
    mean, std = (torch.from_numpy(numbers).float() for numbers in (mean, std))
    return WindowStatistics(scaling, torch.cat([torch.zeros(3), mean]), torch.cat([position, std]))


def _axis_rms(vectors: Float[np.ndarray, "row 3"]) -> Float[np.ndarray, "3"]:
    """Return the root mean square per axis, horizontal axes pooled."""
    square = (vectors**2).mean(0)
    return np.sqrt([square[::2].mean(), square[1], square[::2].mean()]).clip(MIN_WAY_STD)


def body_statistics(
    rotation: Float[Tensor, "window frame 3 3"], bones: Float[Tensor, "row channel"], turn_rad: float
) -> tuple[Float[np.ndarray, "body_channel"], Float[np.ndarray, "body_channel"]]:
    """Return mean and standard deviation, with lower bounds, of root rotation and bones."""
    turns = rigid.rotation_from_vector(np.linspace(-1, 1, 9)[:, None] * [0, turn_rad, 0])
    root = rigid.rotation_to_6d(turns[:, None, None] @ rotation[::4, ::4].double().numpy()).reshape(-1, 6)
    posed = bones.double().numpy()
    floor = np.concatenate([np.full(6, MIN_ROTATION_STD), np.tile(MIN_BONE_STD, posed.shape[-1] // 6)])
    std = np.concatenate([root.std(0), posed.std(0)])
    return np.concatenate([root.mean(0), posed.mean(0)]), np.maximum(std, floor)


def body_channels(
    rotation: Float[Tensor, "*batch 3 3"], bones: Float[Tensor, "*batch channel"]
) -> Float[Tensor, "*batch c"]:
    """Concatenate the root's 6D rotation and the bones."""
    return torch.cat([rigid_torch.rotation_to_6d(rotation), bones], dim=-1)


def with_posture_noise(
    rotation: Float[Tensor, "batch past_frame 3 3"],
    bones: Float[Tensor, "batch past_frame channel"],
    statistics: WindowStatistics,
    augmentation: AugmentationConfig,
    generator: torch.Generator,
) -> tuple[Float[Tensor, "batch past_frame 3 3"], Float[Tensor, "batch past_frame channel"]]:
    """Offset root tilt and bones of some samples, by a constant over all frames."""
    size, channels = len(bones), bones.shape[-1]
    some = (torch.rand(size, 1, generator=generator) < augmentation.posture_offset).float()
    tilt = torch.randn(size, 3, generator=generator) * torch.tensor([1.0, 0.0, 1.0]) * POSTURE_TILT_RAD * some
    bend = torch.randn(size, channels, generator=generator) * statistics.past_std[-channels:]
    bend = bend * POSTURE_BEND * some
    return rigid_torch.so3_exp(tilt)[:, None] @ rotation, bones + bend[:, None]


def _drawn_windows(
    windows: TrainingWindows, augmentation: AugmentationConfig, size: int, generator: torch.Generator
) -> tuple[Int[Tensor, "batch"], Bool[Tensor, "batch"]]:
    """Draw windows with replacement; also return which were drawn for an approaching observer."""
    index = torch.randint(len(windows), (size,), generator=generator)
    wanted = torch.rand(size, generator=generator) < augmentation.approached
    chosen = wanted & (len(windows.approached) > 0)
    often = torch.randint(max(len(windows.approached), 1), (size,), generator=generator)
    index[chosen] = windows.approached[often[chosen]]
    return index, chosen


def _drawn_turns(
    augmentation: AugmentationConfig, size: int, generator: torch.Generator
) -> tuple[Float[Tensor, "batch"], Float[Tensor, "batch 3 3"]]:
    """Draw mirroring (-1, else 1) and the rotation of each ego frame about its up axis."""
    mirrored, turned, share = (torch.rand(size, generator=generator) for _ in range(3))
    jitter_rad = min(largest_turn_rad(augmentation), YAW_JITTER_RAD)
    yaw = (share * 2 - 1) * torch.where(turned < augmentation.turn, torch.pi, jitter_rad)
    side = 1.0 - 2.0 * (mirrored < augmentation.mirror).float()
    return side, rigid_torch.so3_exp(torch.stack([torch.zeros(size), yaw, torch.zeros(size)], dim=-1))


def draw_batch(
    windows: TrainingWindows,
    scene: SceneSampler,
    statistics: WindowStatistics,
    augmentation: AugmentationConfig,
    size: int,
    generator: torch.Generator,
    *,
    bodies: bool = True,
) -> TrainingBatch:
    """Draw and augment windows on the CPU; return the batch on the device of ``scene``.

    Without ``bodies``, which take the longest, these have no frames.
    """
    scaling, count = statistics.scaling, windows.past
    posed = slice(count, None if bodies else count)
    index, chosen = _drawn_windows(windows, augmentation, size, generator)
    side, turn = _drawn_turns(augmentation, size, generator)
    bones_known = windows.bones_known[index] & (side > 0)
    flip = torch.diag_embed(torch.stack([side, torch.ones(size), torch.ones(size)], dim=-1))
    new_from_old = flip @ turn.mT
    tracks = windows.tracks(index)
    root = tracks.root @ new_from_old.mT
    rotation = new_from_old[:, None] @ tracks.rotation @ flip[:, None]
    shift_m = OBSERVER_SHIFT_M if augmentation.past > 0 else 0.0
    shift = torch.randn(size, 1, 3, generator=generator) * shift_m
    observer = (tracks.ego_from_observer[..., :3, 3] + shift) @ new_from_old.mT
    ahead = (tracks.ahead + shift) @ new_from_old.mT
    facing = new_from_old[:, None] @ tracks.ego_from_observer[..., :3, :3] @ flip[:, None]
    frames = windows.frame[index]
    known = rotation[:, :count], windows.bones[frames[:, :count]]
    remembered = body_channels(*with_posture_noise(*known, statistics, augmentation, generator))
    past = torch.cat([root[:, :count], remembered], dim=-1)
    held = past[:, -PerceptionEnsemble.POSTURE_FRAMES :].clone()
    held[~bones_known, :, POSITION + ROOT_CHANNELS :] = statistics.past_mean[POSITION + ROOT_CHANNELS :]
    past = past + torch.randn(past.shape, generator=generator) * statistics.past_std * augmentation.past
    ego = windows.world_from_ego[index] @ rigid_torch.make(turn, torch.zeros(size, 3))
    body = body_channels(rotation[:, posed], windows.bones[frames[:, posed]])
    body = body - torch.from_numpy(scaling.body_mean).float()
    device, future = scene.points.device, root[:, count:]
    track = with_powered_length(future, GOAL_POWER_OF[scaling.encoding])
    track = track / torch.from_numpy(scaling.goal_std).float()
    strides = velocity_channels_from_path(future, root[:, count - 1], windows.rate_hz)
    strides = strides / torch.from_numpy(scaling.velocity_std).float()
    places = future.mT / torch.from_numpy(scaling.path_std).float()
    return TrainingBatch(
        scene(ego.to(device), side.to(device), windows.scene[index].to(device)),
        with_anticipated(other_channels_torch(observer, facing, tracks.companions, new_from_old), ahead),
        past.flatten(1),
        held,
        ((torch.rand(size, generator=generator) >= augmentation.hide_bones) & bones_known).float(),
        bones_known,
        chosen,
        track[:, -1],
        track.mT,
        places if scaling.encoding == "positions" else strides.mT,
        places,
        (body / torch.from_numpy(scaling.body_std).float()).mT,
    ).to(device)
