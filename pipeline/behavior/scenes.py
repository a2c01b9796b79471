"""The scenes of all recordings: a shared one, or one for each.

`Scenes.load` reads what `slice_behavior` wrote; `around` samples the ego grid of each window in the scene of
its recording (`Context.video`).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt

from pipeline.behavior.path_encoding import REST_SPEED_M_S
from pipeline.behavior.perception import GRID_SHAPE, FeatureVolume
from pipeline.behavior.support import Support, smoothed_jumps
from pipeline.behavior.trajectories import RATE_HZ
from pipeline.data import npz
from pipeline.geometry import rigid

INSET_SHARE = 0.01
"""distance of projected points from the faces of an allowed voxel, in voxels"""
TURNS_RAD = np.arange(1, 18) // 2 * (-1) ** np.arange(1, 18) * np.pi / 16
"""rotations tried to move a goal out of solid space, smallest first, up to a right angle either way"""


@dataclass(frozen=True)
class Scenes:
    """Feature volumes and the volume of each recording."""

    volumes: tuple[FeatureVolume, ...]
    allowed: tuple[Bool[np.ndarray, "x y z"], ...]
    """Per volume, where the agent's root may be."""
    of_video: Int[np.ndarray, "video"]
    """Index into ``volumes`` of every recording."""
    supports: tuple[Support | None, ...] = ()
    """Per volume, the supporting surfaces, if known."""

    @classmethod
    def load(cls, folder: Path, videos: tuple[str, ...]) -> "Scenes":
        """Read `volume.npz`, or `volumes/<id>.npz` of every recording. Raises InputError ART-010."""
        one = folder / "volume.npz"
        files = [one] if one.is_file() else [folder / "volumes" / f"{video}.npz" for video in videos]
        tables = [npz.load(file, ("allowed", "stands_m")) for file in files]
        volumes = tuple(FeatureVolume.load(file) for file in files)
        of_video = np.zeros(len(videos), int) if one.is_file() else np.arange(len(videos))
        supports = tuple(
            Support.of(volume, table["allowed"], table["stands_m"])
            for volume, table in zip(volumes, tables, strict=True)
        )
        return cls(volumes, tuple(table["allowed"] > 0 for table in tables), of_video, supports)

    @classmethod
    def of(cls, volume: FeatureVolume) -> "Scenes":
        """Return a scene shared by all recordings; all that is not solid is allowed."""
        return cls((volume,), (volume.occupancy != 1,), np.zeros(1, int))

    def without_features(self) -> "Scenes":
        """Return the scenes without features, for models without scene encoder: as constraints only."""
        volumes = tuple(replace(volume, features=volume.features[:0]) for volume in self.volumes)
        return replace(self, volumes=volumes)

    @property
    def channels(self) -> int:
        """Return the number of features per voxel."""
        return len(self.volumes[0].features)

    def number(self, video: Int[np.ndarray, "window"] | None, windows: int) -> Int[np.ndarray, "window"]:
        """Return the volume of each window given its recording (None: there is one volume)."""
        if len(self.volumes) == 1 or video is None:
            assert len(self.volumes) == 1, "windows of several scenes must name their recording"
            return np.zeros(windows, int)
        return self.of_video[video]

    def around(
        self, ego: Float[np.ndarray, "window 4 4"], video: Int[np.ndarray, "window"] | None
    ) -> Float[np.ndarray, "window channel 64 8 64"]:
        """Sample the ego grid (`world_from_ego`, meters) of every window in its own scene (Eq. 11)."""
        if not self.channels:
            return np.zeros((len(ego), 0, *GRID_SHAPE), np.float32)
        number = self.number(video, len(ego))
        if (number == number[:1]).all() and len(number):
            return self.volumes[number[0]].around(ego)
        grid = np.zeros((len(ego), self.channels, *GRID_SHAPE), np.float32)
        for scene in np.unique(number):
            grid[number == scene] = self.volumes[scene].around(ego[number == scene])
        return grid

    def inside_solid(
        self, points_world: Float[np.ndarray, "window *some 3"], video: Int[np.ndarray, "window"] | None
    ) -> Bool[np.ndarray, "window *some"]:
        """Return which points are inside solid or unmapped space; none if there is no map."""
        number = self.number(video, len(points_world))
        solid = np.zeros(points_world.shape[:-1], bool)
        for scene in np.unique(number):
            if (self.volumes[scene].occupancy == 2).all():
                continue
            voxel, inside = self.volumes[scene].voxel(points_world[number == scene])
            solid[number == scene] = ~(self.allowed[scene][tuple(np.moveaxis(voxel, -1, 0))] & inside)
        return solid

    @cached_property
    def nearest_allowed(self) -> tuple[Int[np.ndarray, "3 x y z"] | None, ...]:
        """Per volume, the allowed voxel nearest to each voxel; None without allowed voxels or map."""
        return tuple(
            np.asarray(distance_transform_edt(~allowed, return_distances=False, return_indices=True))
            if allowed.any() and not (volume.occupancy == 2).all()
            else None
            for volume, allowed in zip(self.volumes, self.allowed, strict=True)
        )

    def out_of_solid(
        self, points_world: Float[np.ndarray, "window *some 3"], video: Int[np.ndarray, "window"] | None
    ) -> Float[np.ndarray, "window *some 3"]:
        """Project points `inside_solid` to the nearest voxel where the agent's root may be."""
        number, moved = self.number(video, len(points_world)), np.array(points_world)
        for scene in np.unique(number):
            nearest, volume, mine = self.nearest_allowed[scene], self.volumes[scene], number == scene
            if nearest is None:
                continue
            voxel, inside = volume.voxel(moved[mine])
            target = np.moveaxis(nearest[:, voxel[..., 0], voxel[..., 1], voxel[..., 2]], 0, -1)
            low = volume.origin + (target + INSET_SHARE) * volume.voxel_m
            free = (target == voxel).all(-1) & inside
            pushed = np.clip(moved[mine], low, low + (1 - 2 * INSET_SHARE) * volume.voxel_m)
            moved[mine] = np.where(free[..., None], moved[mine], pushed)
        return moved

    def support_heights(
        self,
        points_world: Float[np.ndarray, "window *some 3"],
        moves: Bool[np.ndarray, "window *some"],
        video: Int[np.ndarray, "window"] | None,
    ) -> Float[np.ndarray, "window *some"]:
        """Return the supported root heights nearest to those of the points."""
        number, height = self.number(video, len(points_world)), np.array(points_world[..., 1])
        for scene, support in enumerate(self.supports):
            if support is not None:
                mine = number == scene
                height[mine] = support.heights(points_world[mine], moves[mine])
        return height


@dataclass(frozen=True)
class SceneConstraint:
    """Constraints on goals and paths of some agents, each in its own ego frame."""

    scenes: Scenes
    world_from_ego: Float[np.ndarray, "agent 4 4"]
    video: Int[np.ndarray, "agent"] | None

    def __getitem__(self, index: slice | np.ndarray) -> "SceneConstraint":
        """Return some of the agents."""
        video = None if self.video is None else self.video[index]
        return SceneConstraint(self.scenes, self.world_from_ego[index], video)

    def out_of_solid(
        self, points_ego: Float[np.ndarray, "plan point 3"]
    ) -> Float[np.ndarray, "plan point 3"]:
        """Project points out of solid space; the plans of one agent are consecutive."""
        frame, video = self._of_plans(len(points_ego))
        moved = self.scenes.out_of_solid(rigid.apply(frame, points_ego), video)
        return rigid.apply(rigid.inverse(frame), moved)

    def goals_on_support(
        self, goals_ego: Float[np.ndarray, "plan 3"], start_ego: Float[np.ndarray, "plan 3"]
    ) -> Float[np.ndarray, "plan 3"]:
        """Put goals on supporting surfaces, and rotate those in solid space about ``start_ego`` as little as
        possible: projecting to the nearest free voxel instead would cancel flights.
        """
        frame, video = self._of_plans(len(goals_ego))
        start, goals = rigid.apply(frame, start_ego[:, None]), rigid.apply(frame, goals_ego[:, None])
        moved, (x, y, z) = self.scenes.out_of_solid(goals, video), np.moveaxis(goals - start, -1, 0)
        angle = np.where((moved - goals)[..., 0] * z >= (moved - goals)[..., 2] * x, 1, -1) * TURNS_RAD
        cosine, sine = np.cos(angle), np.sin(angle)
        turned = start + np.stack([cosine * x + sine * z, y + 0 * sine, cosine * z - sine * x], axis=-1)
        solid = self.scenes.inside_solid(turned, video)
        first = np.take_along_axis(turned, solid.argmin(1)[:, None, None], axis=1)
        goals = np.where(np.asarray(solid.all(1))[:, None, None], moved, first)
        goals[..., 1] = self.scenes.support_heights(goals, np.zeros(goals.shape[:-1], bool), video)
        return rigid.apply(rigid.inverse(frame), goals)[:, 0]

    def on_support(
        self,
        path_ego: Float[np.ndarray, "plan frame 3"],
        start_ego: Float[np.ndarray, "plan 3"],
        rate_hz: float = RATE_HZ,
    ) -> Float[np.ndarray, "plan frame 3"]:
        """Put paths, which begin a frame after ``start_ego``, on supporting surfaces, smoothing jumps."""
        frame, video = self._of_plans(len(path_ego))
        start, path = rigid.apply(frame, start_ego[:, None]), rigid.apply(frame, path_ego)
        step = np.diff(path[..., [0, 2]], axis=1, prepend=start[..., [0, 2]])
        moves = np.linalg.norm(step, axis=-1) * rate_hz > REST_SPEED_M_S
        path[..., 1] = smoothed_jumps(self.scenes.support_heights(path, moves, video), start[:, 0, 1])
        return rigid.apply(rigid.inverse(frame), path)

    def _of_plans(self, plans: int) -> tuple[Float[np.ndarray, "plan 4 4"], Int[np.ndarray, "plan"] | None]:
        """Return ego frame and recording of every plan."""
        count = plans // len(self.world_from_ego)
        video = None if self.video is None else np.repeat(self.video, count)
        return np.repeat(self.world_from_ego, count, axis=0), video
