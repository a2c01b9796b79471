"""The scenes of all recordings: one home for all of them, or another one for each.

`Scenes.load` reads what `slice_behavior` wrote; `around` samples the ego grid of each window in its own scene, which
the window's `Context.scene` names.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.files import arrays
from pipeline.models.perception import GRID_SHAPE, FeatureVolume


@dataclass(frozen=True)
class Scenes:
    """Feature volumes, and which one each recording was made in."""

    volumes: tuple[FeatureVolume, ...]
    allowed: tuple[Bool[np.ndarray, "x y z"], ...]
    """Per volume, where the agent's root may be."""
    of_video: Int[np.ndarray, "video"]
    """Index into ``volumes`` of every recording."""

    @classmethod
    def load(cls, folder: Path, videos: tuple[str, ...]) -> "Scenes":
        """Read `volume.npz`, or else `volumes/<id>.npz` of every recording. Raises InputError ART-010 when damaged."""
        one = folder / "volume.npz"
        files = [one] if one.is_file() else [folder / "volumes" / f"{video}.npz" for video in videos]
        allowed = [arrays.load(file, ("allowed",))["allowed"].astype(bool) for file in files]
        of_video = np.zeros(len(videos), int) if one.is_file() else np.arange(len(videos))
        return cls(tuple(FeatureVolume.load(file) for file in files), tuple(allowed), of_video)

    @classmethod
    def of(cls, volume: FeatureVolume) -> "Scenes":
        """Return the one scene of all recordings, with all that is free allowed."""
        return cls((volume,), (volume.occupancy != 1,), np.zeros(1, int))

    @property
    def channels(self) -> int:
        """Return the number of features per voxel."""
        return len(self.volumes[0].features)

    def number(self, video: Int[np.ndarray, "window"] | None, windows: int) -> Int[np.ndarray, "window"]:
        """Return the volume of each window, given the numbers of their recordings (None: there is one volume)."""
        if len(self.volumes) == 1 or video is None:
            assert len(self.volumes) == 1, "windows of several scenes must tell their recording"
            return np.zeros(windows, int)
        return self.of_video[video]

    def around(
        self, ego: Float[np.ndarray, "window 4 4"], video: Int[np.ndarray, "window"] | None
    ) -> Float[np.ndarray, "window channel 64 8 64"]:
        """Sample the ego grid of every window in its own scene."""
        number = self.number(video, len(ego))
        grid = np.zeros((len(ego), self.channels, *GRID_SHAPE), np.float32)
        for scene in np.unique(number):
            grid[number == scene] = self.volumes[scene].around(ego[number == scene])
        return grid

    def inside_solid(
        self, points_world: Float[np.ndarray, "window *some 3"], video: Int[np.ndarray, "window"] | None
    ) -> Bool[np.ndarray, "window *some"]:
        """Tell which points lie inside something solid or outside the mapped space; none where nothing was mapped."""
        number = self.number(video, len(points_world))
        solid = np.zeros(points_world.shape[:-1], bool)
        for scene in np.unique(number):
            if (self.volumes[scene].occupancy == 2).all():
                continue
            voxel, inside = self.volumes[scene].voxel(points_world[number == scene])
            solid[number == scene] = ~(self.allowed[scene][tuple(np.moveaxis(voxel, -1, 0))] & inside)
        return solid
