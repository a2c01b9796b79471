"""Trajectories of agent and observer on a regular time grid, and the windows of behavior models.

`slice_behavior` writes them, `BehaviorData.load` reads them, and `BehaviorData.windows` returns windows as a
`Context` (the past, all that a predictor may see) and a `Future` (what it must predict).
"""

from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.core.errors import InputError
from pipeline.data import npz
from pipeline.geometry import rigid

RATE_HZ = 10
"""Frames per second, unless `slice_behavior` sets another rate; that of the page and of long-term motion."""
PAST = 8
"""Frames of the past, unless `slice_behavior` sets another past."""
FUTURE = 56
"""Frames of the future, unless `train_behavior` sets another horizon."""
TRAIN, TEST = 0, 1
UP = np.array([0.0, 1.0, 0.0])
KINDS = ("person", "animal")
"""kinds that the fourth channel of a companion indexes; the first three are its position"""
ABSENT_M = 1000.0
"""distance at which absent others are placed, meters"""
ANTICIPATED_SHARES = (1 / 7, 2 / 7, 1 / 2, 1)
"""shares of the horizon after which a model may know where the observer will be"""
STEP_FRAMES = 3
"""last frames of a past that give the observer's velocity"""
MAX_COMPANIONS = 15
"""maximum number of companions, the nearest: more hardly fit into the radius, nor crowds into memory"""
WINDOWS_AT_ONCE = 8192
"""bounds the memory of distant companions"""


@dataclass(frozen=True)
class Trajectory:
    """One recording on a regular time grid; transforms are finite wherever ``valid``."""

    timestamp_s: Float[np.ndarray, "frame"]
    world_from_agent: Float[np.ndarray, "frame 4 4"]
    agent_from_bone: Float[np.ndarray, "frame bone 4 4"]
    world_from_camera: Float[np.ndarray, "frame 4 4"]
    valid: Bool[np.ndarray, "frame"]
    companions: Float[np.ndarray, "frame companion 4"] | None = None
    """others beside the observer: world position and index into `KINDS`; NaN in frames without them"""


@dataclass(frozen=True)
class Context:
    """The past frames of windows (8 by default), the current one last, in the world frame."""

    world_from_agent: Float[np.ndarray, "window past_frame 4 4"]
    agent_from_bone: Float[np.ndarray, "window past_frame bone 4 4"]
    observer_world: Float[np.ndarray, "window past_frame 3"]
    video: Int[np.ndarray, "window"] | None = None
    """index of the recording, which determines the scene; None if there is one scene"""
    observer_rotation: Float[np.ndarray, "window past_frame 3 3"] | None = None
    """of ``world_from_camera``; None where only positions are known"""
    companions: Float[np.ndarray, "window companion past_frame 4"] | None = None
    """others beside the observer, as in a `Trajectory`; None where there are none"""

    def __getitem__(self, index: slice | np.ndarray) -> "Context":
        """Return some of the windows."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(self, **{name: array[index] for name, array in arrays.items() if array is not None})

    def __len__(self) -> int:
        return len(self.world_from_agent)

    @property
    def world_from_observer(self) -> Float[np.ndarray, "window 8 4 4"]:
        """The observer's poses (OpenCV axes); if rotations are unknown, it looks at the agent, upright."""
        if self.observer_rotation is not None:
            return rigid.make(self.observer_rotation, self.observer_world)
        return rigid.look_at(self.observer_world, self.world_from_agent[..., :3, 3], UP)


@dataclass(frozen=True)
class Future:
    """The future frames of windows in the world frame; the goal is the root's last position."""

    world_from_agent: Float[np.ndarray, "window frame 4 4"]
    agent_from_bone: Float[np.ndarray, "window frame bone 4 4"]

    @property
    def goal_world(self) -> Float[np.ndarray, "window 3"]:
        """The root's position at the horizon (Z of the paper)."""
        return self.world_from_agent[:, -1, :3, 3]

    @property
    def path_world(self) -> Float[np.ndarray, "window frame 3"]:
        """The root's positions (P of the paper)."""
        return self.world_from_agent[:, :, :3, 3]


@dataclass(frozen=True)
class PoseFrames:
    """Consecutive poses of animals: root, and bone channels as in `behavior.json`."""

    root: Float[np.ndarray, "*animal frame 4 4"]
    bones: Float[np.ndarray, "*animal frame channel"]

    def __getitem__(self, part: slice) -> "PoseFrames":
        """Return some of the frames."""
        return PoseFrames(self.root[..., part, :, :], self.bones[..., part, :])


def frames_from_seconds(seconds: float, rate_hz: float = RATE_HZ) -> int:
    """Return the frames of a horizon. Raises InputError BEH-003 unless the UNets can halve it twice."""
    frames = round(seconds * rate_hz)
    if frames <= 0 or frames % 4:
        remedy = f"take a multiple of four frames: {4 / rate_hz:g} s"
        raise InputError("BEH-003", f"cannot predict {seconds:g} s", "horizon_s", remedy)
    return frames


def anticipated_frames(future: int) -> Int[np.ndarray, "anticipated_frame"]:
    """Return the frames of a plan for which a model may know where the observer will be, counted from 1."""
    return np.array([max(round(share * future), 1) for share in ANTICIPATED_SHARES])


def anticipated(
    observer: Float[np.ndarray, "window past_frame 3"],
    agent: Float[np.ndarray, "window 3"],
    frames: Int[np.ndarray, "anticipated_frame"],
) -> Float[np.ndarray, "window anticipated_frame 3"]:
    """Return where observers will be if they go on as now, up to where they are nearest to the agent.

    Whoever stands is expected to stand. Positions are in one frame with +y up, meters.
    """
    count, now = min(STEP_FRAMES, observer.shape[1] - 1), observer[:, -1]
    step = (now - observer[:, -1 - count]) * [1.0, 0.0, 1.0] / count
    nearest_at = ((agent - now) * step).sum(-1) / np.maximum((step**2).sum(-1), np.finfo(float).tiny)
    last = np.where(nearest_at > 0, nearest_at, np.inf)
    return now[:, None] + step[:, None] * np.minimum(frames, last[:, None])[..., None]


def window_starts(
    valid: Bool[np.ndarray, "frame"], length: int, stride: int = 1
) -> Int[np.ndarray, "window"]:
    """Return the first frames of all windows of ``length`` valid frames."""
    if len(valid) < length:
        return np.zeros(0, np.int64)
    run = np.lib.stride_tricks.sliding_window_view(valid, length).all(-1)
    return np.flatnonzero(run & (np.arange(run.size) % stride == 0))


@dataclass(frozen=True)
class BehaviorData:
    """The content of `behavior_data/`: trajectories per recording and the list of windows."""

    trajectories: dict[str, Trajectory]
    agent_from_bone_rest: Float[np.ndarray, "bone 4 4"]
    video: Int[np.ndarray, "window"]
    """index into ``videos``"""
    start: Int[np.ndarray, "window"]
    """first frame"""
    tested: Bool[np.ndarray, "video"]
    """whether a recording is held out for testing; the others are for training"""
    videos: tuple[str, ...]
    stride: int = 1
    """frames between the starts of training windows; test windows start at every frame"""
    future: int = FUTURE
    """predicted frames"""
    past: int = PAST
    """known frames"""
    rate_hz: float = RATE_HZ
    """frames per second"""

    @classmethod
    def load(cls, folder: Path) -> "BehaviorData":
        """Read ``trajectories.npz`` and ``windows.npz``. Raises InputError ART-010 when damaged."""
        lists, lengths = ("video", "start", "tested", "videos"), ("stride", "future", "past", "rate_hz")
        tracks = npz.load(folder / "trajectories.npz")
        windows = npz.load(folder / "windows.npz", (*lists, *lengths))
        videos = tuple(str(video) for video in windows["videos"])
        names = ("timestamp_s", "world_from_agent", "agent_from_bone", "world_from_camera", "valid")
        trajectories = {
            video: Trajectory(
                **{name: tracks[f"{video}/{name}"] for name in names},
                companions=tracks.get(f"{video}/companions"),
            )
            for video in videos
        }
        listed = windows["video"], windows["start"], windows["tested"], videos
        counts = (windows[name].item() for name in lengths)
        return cls(trajectories, tracks["agent_from_bone_rest"], *listed, *counts)

    def save(self, folder: Path) -> None:
        """Write ``trajectories.npz`` and ``windows.npz``."""
        tracks = {
            f"{video}/{name}": value
            for video, trajectory in self.trajectories.items()
            for name, value in vars(trajectory).items()
            if value is not None
        }
        npz.save(folder / "trajectories.npz", agent_from_bone_rest=self.agent_from_bone_rest, **tracks)
        npz.save(
            folder / "windows.npz",
            video=self.video,
            start=self.start,
            tested=self.tested,
            videos=np.array(self.videos, np.str_),
            stride=np.array(self.stride, np.int64),
            future=np.array(self.future, np.int64),
            past=np.array(self.past, np.int64),
            rate_hz=np.array(self.rate_hz),
        )

    @property
    def accompanied(self) -> bool:
        """Whether any recording has companions."""
        return any(track.companions is not None for track in self.trajectories.values())

    @cached_property
    def begin_s(self) -> Float[np.ndarray, "window"]:
        """Time of each window's first frame in its recording, seconds."""
        times = [self.trajectories[name].timestamp_s for name in self.videos]
        return np.array([times[video][start] for video, start in zip(self.video, self.start, strict=True)])

    @cached_property
    def place_world(self) -> Float[np.ndarray, "window 3"]:
        """The root's position in each window's current frame, meters."""
        roots, current = [self.trajectories[name].world_from_agent for name in self.videos], self.past - 1
        both = zip(self.video, self.start + current, strict=True)
        return np.array([roots[video][frame, :3, 3] for video, frame in both]).reshape(-1, 3)

    @property
    def split(self) -> Int[np.ndarray, "window"]:
        """Split of each window, that of its recording: 0 train, 1 test."""
        return np.where(self.tested, TEST, TRAIN)[self.video]

    @property
    def training(self) -> dict[str, Trajectory]:
        """The recordings for training, also those too short for a window."""
        return {str(name): self.trajectories[name] for name in np.array(self.videos)[~self.tested]}

    def indices(self, split: int) -> Int[np.ndarray, "window"]:
        """Return the windows of one split."""
        return np.flatnonzero(self.split == split)

    def with_horizon(self, future: int) -> "BehaviorData":
        """Return the windows of the same recordings with another horizon, in frames."""
        return self if future == self.future else replace(self, future=future).sliced()

    def sliced(self) -> "BehaviorData":
        """Return the data with all valid windows of its lengths: training ones every `stride` frames."""
        valid = (self.trajectories[name].valid for name in self.videos)
        strides = np.where(self.tested, 1, self.stride).tolist()
        both = zip(valid, strides, strict=True)
        starts = [window_starts(frames, self.past + self.future, stride) for frames, stride in both]
        video = np.repeat(np.arange(len(starts)), [len(mine) for mine in starts]).astype(np.int32)
        return replace(self, video=video, start=np.concatenate(starts).astype(np.int32))

    def windows(self, index: Int[np.ndarray, "window"], *, bones: bool = True) -> tuple[Context, Future]:
        """Return windows by index; without ``bones``, which take most of the memory, these are empty."""
        frames = self.start[index][:, None] + np.arange(self.past + self.future)

        def gather(name: str, part: slice = slice(None)) -> np.ndarray:
            first = getattr(self.trajectories[self.videos[0]], name)[0][part]
            whole = np.empty((*frames.shape, *first.shape), first.dtype)
            for video in np.unique(self.video[index]):
                mine = self.video[index] == video
                whole[mine] = getattr(self.trajectories[self.videos[video]], name)[frames[mine]][:, :, part]
            return whole

        agent, camera = gather("world_from_agent"), gather("world_from_camera")
        bone = gather("agent_from_bone", slice(None) if bones else slice(0, 0))
        observer, companions = camera[:, : self.past], self.companions(index, frames[:, : self.past])
        past, others = (agent[:, : self.past], bone[:, : self.past]), (observer[..., :3, :3], companions)
        context = Context(*past, observer[..., :3, 3], self.video[index], *others)
        return context, Future(agent[:, self.past :], bone[:, self.past :])

    def companions(
        self, index: Int[np.ndarray, "window"], frames: Int[np.ndarray, "window past_frame"]
    ) -> Float[np.ndarray, "window companion past_frame 4"] | None:
        """Return companions of the windows' recordings in these frames; NaN if absent, None without any."""
        tracks = [self.trajectories[name].companions for name in self.videos]
        most = max((track.shape[1] for track in tracks if track is not None), default=0)
        if not most:
            return None
        whole = np.full((len(frames), most, frames.shape[1], 4), np.nan)
        for video in np.unique(self.video[index]):
            track, mine = tracks[video], self.video[index] == video
            if track is not None:
                whole[mine, : track.shape[1]] = np.swapaxes(track[frames[mine]], 1, 2)
        return whole

    def nearest_companions(
        self, index: Int[np.ndarray, "window"], agent: Float[np.ndarray, "window 3"]
    ) -> Float[np.ndarray, "window some past_frame 4"]:
        """Return the `nearest` companions in some windows; ``agent`` is its current position."""
        parts = []
        for begin in range(0, len(index), WINDOWS_AT_ONCE):
            some = slice(begin, begin + WINDOWS_AT_ONCE)
            there = self.companions(index[some], self.start[index[some]][:, None] + np.arange(self.past))
            if there is not None:
                parts.append(nearest(there, agent[some])[0])
        most = max((part.shape[1] for part in parts), default=0)
        whole = np.zeros((len(index), most, self.past, 4), np.float32)
        whole[..., :3] = agent[:, None, None] + np.array([ABSENT_M, 0.0, 0.0])
        for number, part in enumerate(parts):
            begin = number * WINDOWS_AT_ONCE
            whole[begin : begin + len(part), : part.shape[1]] = part
        return whole


def as_companions(
    positions_world: Float[np.ndarray, "*animal past_frame 3"],
) -> Float[np.ndarray, "*animal past_frame 4"]:
    """Return the tracks of animals as companions: positions and kind."""
    kind = np.full_like(positions_world[..., :1], KINDS.index("animal"))
    return np.concatenate([positions_world, kind], axis=-1)


def nearest(
    companions: Float[np.ndarray, "window companion past_frame 4"], agent: Float[np.ndarray, "window 3"]
) -> tuple[Float[np.ndarray, "window some past_frame 4"], Int[np.ndarray, "window some"]]:
    """Return the companions nearest to the agent's current position, at most `MAX_COMPANIONS`, the nearest
    first, and their indices.

    Positions are meters in one frame. Companions with NaN in the last frame are absent; earlier frames that
    are unknown take the first known position, so that nothing of the future is needed.
    """
    level = [0, 2]
    distance = np.linalg.norm(companions[:, :, -1, level] - agent[:, None, level], axis=-1)
    count = min(int(np.isfinite(distance).sum(1).max(initial=0)), MAX_COMPANIONS)
    order = np.argsort(np.nan_to_num(distance, nan=np.inf), axis=1, kind="stable")[:, :count]
    some = np.take_along_axis(companions, order[..., None, None], axis=1)
    for frame in range(some.shape[2] - 2, -1, -1):
        unknown = np.isnan(some[:, :, frame]).any(-1)
        some[:, :, frame][unknown] = some[:, :, frame + 1][unknown]
    absent = np.asarray(np.isnan(some[:, :, -1]).any(-1))
    far = np.pad(agent + np.array([ABSENT_M, 0.0, 0.0]), ((0, 0), (0, 1)))
    return np.where(absent[..., None, None], far[:, None, None], some), order


def blended_frames(old: PoseFrames, new: PoseFrames, frames: int) -> PoseFrames:
    """Cross-fade the first frames of a new plan with the remaining ones of the old plan."""
    count = min(frames, old.root.shape[-3], new.root.shape[-3])
    if count <= 0:
        return new
    old, begin, share = old[:count], new[:count], ((np.arange(count) + 1.0) / (count + 1))[:, None]
    turn = rigid.vector_from_rotation(np.swapaxes(old.root[..., :3, :3], -1, -2) @ begin.root[..., :3, :3])
    position = old.root[..., :3, 3] * (1 - share) + begin.root[..., :3, 3] * share
    root, bones = new.root.copy(), new.bones.copy()
    root[..., :count, :, :] = rigid.make(
        old.root[..., :3, :3] @ rigid.rotation_from_vector(turn * share), position
    )
    bones[..., :count, :] = old.bones * (1 - share) + begin.bones * share
    return PoseFrames(root, bones)
