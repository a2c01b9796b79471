"""Trajectories of agent and observer on one time grid, and the windows that behaviour models learn from.

`slice_behavior` writes them; `BehaviorData.load` reads them back; `BehaviorData.windows` gathers any set of
windows as a `Context` (the past, all that a predictor may see) and a `Future` (what it must predict).
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, Integer

from pipeline.core.errors import InputError
from pipeline.data import npz
from pipeline.geometry import rigid

RATE_HZ = 10
PAST = 8
FUTURE = 56
TRAIN, TEST = 0, 1
UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class Trajectory:
    """One recording on the 10 Hz grid; transforms hold finite numbers wherever ``valid``."""

    timestamp_s: Float[np.ndarray, "frame"]
    world_from_agent: Float[np.ndarray, "frame 4 4"]
    agent_from_bone: Float[np.ndarray, "frame bone 4 4"]
    world_from_camera: Float[np.ndarray, "frame 4 4"]
    valid: Bool[np.ndarray, "frame"]


@dataclass(frozen=True)
class Context:
    """The 8 past frames of windows, the current one last, in the world frame."""

    world_from_agent: Float[np.ndarray, "window 8 4 4"]
    agent_from_bone: Float[np.ndarray, "window 8 bone 4 4"]
    observer_world: Float[np.ndarray, "window 8 3"]
    video: Int[np.ndarray, "window"] | None = None
    """number of the recording, which names the scene; None where there is one scene"""
    observer_rotation: Float[np.ndarray, "window 8 3 3"] | None = None
    """of ``world_from_camera``; None where only positions are known"""

    def __getitem__(self, index: slice | np.ndarray) -> "Context":
        """Return some of the windows."""
        video = None if self.video is None else self.video[index]
        rotation = None if self.observer_rotation is None else self.observer_rotation[index]
        return Context(
            self.world_from_agent[index],
            self.agent_from_bone[index],
            self.observer_world[index],
            video,
            rotation,
        )

    def __len__(self) -> int:
        return len(self.world_from_agent)

    @property
    def world_from_observer(self) -> Float[np.ndarray, "window 8 4 4"]:
        """The observer's poses (OpenCV axes); one whose rotation is not known looks at the agent, upright."""
        if self.observer_rotation is not None:
            return rigid.make(self.observer_rotation, self.observer_world)
        return rigid.look_at(self.observer_world, self.world_from_agent[..., :3, 3], UP)


@dataclass(frozen=True)
class Future:
    """The 56 future frames of windows in the world frame; the goal is the root's last position."""

    world_from_agent: Float[np.ndarray, "window frame 4 4"]
    agent_from_bone: Float[np.ndarray, "window frame bone 4 4"]

    @property
    def goal_world(self) -> Float[np.ndarray, "window 3"]:
        """The root's position after 5.6 s (Z of the paper)."""
        return self.world_from_agent[:, -1, :3, 3]

    @property
    def path_world(self) -> Float[np.ndarray, "window frame 3"]:
        """The root's positions (P of the paper)."""
        return self.world_from_agent[:, :, :3, 3]


def frames_from_seconds(seconds: float) -> int:
    """Return the frames of a horizon. Raises InputError BEH-003 where the UNets could not halve it twice."""
    frames = round(seconds * RATE_HZ)
    if frames <= 0 or frames % 4:
        raise InputError(
            "BEH-003", f"cannot predict {seconds:g} s", "horizon_s", "take a multiple of 0.4 s: 4.0, 5.6, 7.2"
        )
    return frames


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
    """Everything in `behavior_data/`: trajectories per recording and the exact list of windows."""

    trajectories: dict[str, Trajectory]
    agent_from_bone_rest: Float[np.ndarray, "bone 4 4"]
    video: Int[np.ndarray, "window"]
    """index into ``videos``"""
    start: Int[np.ndarray, "window"]
    """first of the 64 frames"""
    split: Integer[np.ndarray, "window"]
    """0 train, 1 test"""
    videos: tuple[str, ...]
    future: int = FUTURE
    """frames that are predicted"""

    @classmethod
    def load(cls, folder: Path) -> "BehaviorData":
        """Read ``trajectories.npz`` and ``windows.npz``. Raises InputError ART-010 when damaged."""
        tracks, windows = npz.load(folder / "trajectories.npz"), npz.load(folder / "windows.npz")
        videos = tuple(str(video) for video in windows["videos"])
        names = ("timestamp_s", "world_from_agent", "agent_from_bone", "world_from_camera", "valid")
        trajectories = {video: Trajectory(*(tracks[f"{video}/{name}"] for name in names)) for video in videos}
        return cls(
            trajectories,
            tracks["agent_from_bone_rest"],
            windows["video"],
            windows["start"],
            windows["split"],
            videos,
        )

    def save(self, folder: Path) -> None:
        """Write ``trajectories.npz`` and ``windows.npz``."""
        tracks = {
            f"{video}/{name}": value
            for video, trajectory in self.trajectories.items()
            for name, value in vars(trajectory).items()
        }
        npz.save(folder / "trajectories.npz", agent_from_bone_rest=self.agent_from_bone_rest, **tracks)
        npz.save(
            folder / "windows.npz",
            video=self.video,
            start=self.start,
            split=self.split,
            videos=np.array(self.videos, np.str_),
        )

    def indices(self, split: int) -> Int[np.ndarray, "window"]:
        """Return the windows of one split."""
        return np.flatnonzero(self.split == split)

    def with_horizon(self, future: int) -> "BehaviorData":
        """Return the same recordings cut into windows of another horizon, in frames, all that are valid
        throughout.

        Recordings without any window, of which nobody knows whether they are for the test, stay without.
        """
        if future == self.future:
            return self
        split_of = dict(zip(self.video.tolist(), self.split.tolist(), strict=True))
        valid = [
            self.trajectories[name].valid & (number in split_of) for number, name in enumerate(self.videos)
        ]
        starts = [window_starts(frames, PAST + future) for frames in valid]
        video = np.repeat(np.arange(len(starts)), [len(mine) for mine in starts]).astype(np.int32)
        split = np.array([split_of[number] for number in video.tolist()], np.uint8)
        return replace(
            self, video=video, start=np.concatenate(starts).astype(np.int32), split=split, future=future
        )

    def windows(self, index: Int[np.ndarray, "window"], *, bones: bool = True) -> tuple[Context, Future]:
        """Gather windows by their number in the list; without ``bones``, which take most of the memory, there
        are none.
        """
        frames = self.start[index][:, None] + np.arange(PAST + self.future)

        def gathered(name: str, part: slice = slice(None)) -> np.ndarray:
            first = getattr(self.trajectories[self.videos[0]], name)[0][part]
            whole = np.empty((*frames.shape, *first.shape), first.dtype)
            for video in np.unique(self.video[index]):
                mine = self.video[index] == video
                whole[mine] = getattr(self.trajectories[self.videos[video]], name)[frames[mine]][:, :, part]
            return whole

        agent, camera = gathered("world_from_agent"), gathered("world_from_camera")
        bone = gathered("agent_from_bone", slice(None) if bones else slice(0, 0))
        observer = camera[:, :PAST]
        context = Context(
            agent[:, :PAST], bone[:, :PAST], observer[..., :3, 3], self.video[index], observer[..., :3, :3]
        )
        return context, Future(agent[:, PAST:], bone[:, PAST:])
