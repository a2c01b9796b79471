"""The animals of one build in the reconstructed home of another; both homes are in meters.

`ReconstructedHome.of_build` opens the home of a finished build. `move_in` puts all animals of a home
into another one: features are converted to the basis that their models were trained on, recorded moments are
placed on the other floor, and `share_known` measures how much of the other home looks like their own.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from pipeline.backends.daisy import FeatureBasis
from pipeline.backends.descriptors import Describer
from pipeline.behavior.path_encoding import REST_SPEED_M_S
from pipeline.behavior.perception import FeatureVolume
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.support import SUPPORTED, Support, floor_level, level_beneath, with_headroom
from pipeline.behavior.trajectories import TEST, TRAIN, BehaviorData, Trajectory
from pipeline.core.errors import InputError
from pipeline.data import npz
from pipeline.environments.moments import moments_together, recorded_at
from pipeline.geometry import rigid, subsampling
from pipeline.workflow import artifact

ARTIFACTS = ("behavior_data", "feature_basis", "scene_template")
"""Artifacts of a build that describe its home."""
STARTS = {TRAIN: 64, TEST: 32}
"""Recorded moments of each split that are placed, evenly chosen."""
PLACE_DRAWS = 200
"""Places tried for a moment before it is skipped."""
PRESENT_M = 20.0
"""Observers farther than this were not in the home and need no free place."""
APART_M = 0.5
"""Surface cells nearer than this show the same thing and are not compared within a home."""
KNOWN_PERCENT = 95.0
"""Percentage of the own home's cells that count as known, compared with its cells elsewhere."""
MAX_CELLS = 4000
"""Surface cells of a home that are compared, evenly chosen."""


@dataclass(frozen=True)
class ReconstructedHome:
    """A build's home as behavior models perceive it, in the world frame of that build."""

    volume: FeatureVolume
    marks: UInt8[np.ndarray, "x y z"]
    """Where a root may be, and where something carries it, see `pipeline.behavior.support`."""
    stands_m: Float[np.ndarray, "2 2"]
    """Of the build's own animal, see `Support.range_m`."""
    basis: FeatureBasis
    describer: Describer
    floor_m: float
    """World height of the floor."""

    @classmethod
    def of_build(cls, build: Path) -> "ReconstructedHome":
        """Open the home of `build/<agent>`, or of one animal of several, `build/<agent>/animals/<name>`.

        Raises as `load` does, ART-003 where an artifact is not there, ART-007 where another version wrote it.
        """
        home = build.parent.parent if build.parent.name == "animals" else build
        paths = [(build if (build / name).is_dir() else home) / name for name in ARTIFACTS]
        remedy = "make <agent>.behavior_data, of an agent with recordings"
        if (build / "animals").is_dir():
            remedy = f"give the home of one of its animals: {build}/animals/<name>"
        for path in paths:
            artifact.require(path.parent, path.name, remedy=remedy)
        return cls.load(*paths)

    @classmethod
    def load(cls, behavior_data: Path, feature_basis: Path, scene_template: Path) -> "ReconstructedHome":
        """Read the artifacts. Raises ART-007 where another version wrote them, SIM-011 where they describe no
        home that an animal can move into or out of.
        """
        path = behavior_data / "volume.npz"
        if not path.is_file():
            raise _unusable("has a home for each recording", behavior_data)
        try:
            table = npz.load(path, ("features", "occupancy", "origin", "voxel_m", "allowed", "stands_m"))
            basis, describer = FeatureBasis.load(feature_basis), Describer.load(feature_basis)
            scale = str(json.loads((scene_template / "world.json").read_text())["scale"])
        except (InputError, OSError, ValueError, KeyError, TypeError) as error:
            raise _other_version(f"is no home as this version writes it ({error})", behavior_data) from error
        if scale.startswith("relative"):
            raise _unusable("is not in meters: its scale comes from pictures alone", scene_template)
        level = floor_level(table["allowed"] >= SUPPORTED)
        if level is None or not np.isfinite(table["stands_m"]).all():
            raise _unusable("shows no floor that carries an animal", behavior_data)
        arrays = table["features"], table["occupancy"], table["origin"]
        volume = FeatureVolume(*arrays, float(table["voxel_m"]))
        floor_m = float(volume.origin[1] + level * volume.voxel_m)
        return cls(volume, table["allowed"], table["stands_m"], basis, describer, floor_m)

    def scenes(self) -> Scenes:
        """Return the home as the only scene of all recordings."""
        support = Support.of(self.volume, self.marks, self.stands_m)
        return Scenes((self.volume,), (self.marks > 0,), np.zeros(1, int), (support,))

    def fitting(self, stands_m: Float[np.ndarray, "2 2"]) -> "ReconstructedHome":
        """Return the home for a body of other heights, with supports where it fits."""
        marks = with_headroom(self.marks, self.volume.voxel_m, stands_m)
        return replace(self, marks=marks, stands_m=stands_m)

    def height_above_top(self, track: Trajectory, count: int) -> float:
        """Return the height of the root above its support in the last of ``count`` frames, meters, clipped to
        the animal's usual range at rest or in motion.
        """
        before, root = track.world_from_agent[count - 2 : count, :3, 3]
        step_s = track.timestamp_s[count - 1] - track.timestamp_s[count - 2]
        moves = bool(np.hypot(*(root - before)[[0, 2]]) > REST_SPEED_M_S * step_s)
        level = level_beneath(self.volume, self.marks, root[None])[0]
        top = self.volume.origin[1] + level * self.volume.voxel_m if np.isfinite(level) else self.floor_m
        return float(np.clip(root[1] - top, *self.stands_m[int(moves)]))


@dataclass(frozen=True)
class MovedAnimal:
    """An animal in another home."""

    home: ReconstructedHome
    """The other home as its model perceives it, for its own body."""
    data: BehaviorData
    """Recorded moments as they would begin there: the known frames of each are valid."""
    share_known: float
    """Share (0..1) of the other home's surface cells that look like the known home's."""


def move_in(
    animals: Mapping[str, tuple[ReconstructedHome, BehaviorData]], other: ReconstructedHome
) -> dict[str, MovedAnimal]:
    """Put all animals of a home, each as it perceives it and with its recordings, into the other home.

    Raises ART-007 and SIM-011 as `perceived` does, SIM-011 where no moment fits in.
    """
    seen = {name: perceived(own, other).fitting(own.stands_m) for name, (own, _) in animals.items()}
    starts = place_starts(animals, seen, np.random.default_rng(0))
    return {
        name: MovedAnimal(seen[name], starts[name], share_known(own, seen[name]))
        for name, (own, _) in animals.items()
    }


def perceived(own: ReconstructedHome, other: ReconstructedHome) -> ReconstructedHome:
    """Return the other home with features as a model learned in ``own`` reads them. Raises ART-007 where the
    volumes are not of one kind, SIM-011 where features cannot be compared.
    """
    if other.volume.voxel_m != own.volume.voxel_m or len(other.volume.features) != len(own.volume.features):
        raise _other_version("has another kind of volume than the animal's own", Path("the other home"))
    if other.describer != own.describer:
        what = f"has features of {other.describer.backend}, the animal's own of {own.describer.backend}"
        raise _unusable(what, Path("the other home"))
    features = change_basis(other.volume.features, other.basis, own.basis)
    return replace(other, volume=replace(other.volume, features=features))


def change_basis(
    features: Float[np.ndarray, "channel x y z"], written: FeatureBasis, read: FeatureBasis
) -> Float[np.ndarray, "channel x y z"]:
    """Return features of the basis ``written`` as the basis ``read`` would have them.

    A projection of the median length is lifted back to descriptors by the pseudo-inverse and projected anew;
    lengths stay. What descriptors hold outside of the axes ``written`` is lost.
    """
    if all(np.array_equal(getattr(written, name), getattr(read, name)) for name in ("mean", "components")):
        return features
    cells = np.moveaxis(features, 0, -1).astype(np.float64)
    length = np.linalg.norm(cells, axis=-1, keepdims=True)
    known = length[..., 0] > 0
    unit = cells[known] / length[known]
    raw = written.mean + (written.scale * unit) @ np.linalg.pinv(written.components).T
    cells[known] = length[known] * read.project(raw)
    return np.moveaxis(cells, -1, 0).astype(features.dtype)


def share_known(own: ReconstructedHome, other: ReconstructedHome) -> float:
    """Return the share of surface cells of ``other`` that look like cells of ``own``.

    The nearest one is no less alike than `KNOWN_PERCENT` of the cells of ``own`` are to their nearest one
    elsewhere in it.

    Alike are feature, of unit length, and height above the floor, a meter of which counts as much as features
    60 degrees apart.
    """
    known, place = _surface(own)
    visited, _ = _surface(other)
    if not len(known) or not len(visited):
        return 0.0
    gap = cdist(known, known)
    gap[cdist(place, place) < APART_M] = np.inf
    usual = gap.min(1)
    limit = np.percentile(usual[np.isfinite(usual)], KNOWN_PERCENT) if np.isfinite(usual).any() else 0.0
    return float((KDTree(known).query(visited)[0] <= limit).mean())


def _surface(home: ReconstructedHome) -> tuple[Float[np.ndarray, "cell 17"], Float[np.ndarray, "cell 3"]]:
    """Return what surface cells look like, and where they are (meters)."""
    volume = home.volume
    length = np.linalg.norm(volume.features.astype(np.float32), axis=0)
    index = np.argwhere((volume.occupancy == 1) & (length > 0))
    index = index[subsampling.evenly(len(index), MAX_CELLS)]
    at = tuple(index.T)
    place = volume.origin + (index + 0.5) * volume.voxel_m
    look = volume.features[(slice(None), *at)].astype(np.float32) / length[at]
    return np.concatenate([look.T, place[:, 1:2] - home.floor_m], axis=1).astype(np.float32), place


def place_starts(
    animals: Mapping[str, tuple[ReconstructedHome, BehaviorData]],
    seen: Mapping[str, ReconstructedHome],
    rng: np.random.Generator,
) -> dict[str, BehaviorData]:
    """Place recorded moments of all animals on the floor of the other home, ``seen`` with the body of each;
    a moment moves rigidly as a whole.

    Each becomes a recording `<recording>-<first frame>` of the first animal, whose past frames are valid;
    the others are where they were then, or at the nearest recorded time. Animals keep their heights above
    their supports, the observer its height above the floor; an observer who was present stands on the floor.
    Raises SIM-011 if no moment fits.
    """
    data = {name: recorded for name, (_, recorded) in animals.items()}
    owns = {name: own for name, (own, _) in animals.items()}
    leading, splits = next(iter(data)), []
    tracks: dict[str, dict[str, Trajectory]] = {name: {} for name in data}
    scenes, floor = {name: home.scenes() for name, home in seen.items()}, _floor_places(seen[leading])
    for split, count in STARTS.items():
        windows = data[leading].indices(split)
        for window in windows[subsampling.evenly(len(windows), count)].tolist():
            begun = moments_together(data, leading, window, split)
            moments = {name: _cut(data[name], each) for name, each in begun.items()}
            placed = _placed(moments, owns, seen[leading], scenes, floor, rng)
            if placed is not None:
                begin = f"{data[leading].videos[data[leading].video[window]]}-{data[leading].start[window]}"
                for name, track in placed.items():
                    tracks[name][begin] = track
                splits.append(split)
    if TRAIN not in splits:
        what = "has no free floor on which the animal can be set down, or all animals together"
        raise _unusable(what, Path("the other home"))
    number = np.arange(len(splits), dtype=np.int32)
    windows = {"video": number, "start": np.zeros_like(number), "tested": np.array(splits) == TEST}
    return {
        name: replace(data[name], trajectories=mine, videos=tuple(mine), **windows)
        for name, mine in tracks.items()
    }


def _floor_places(home: ReconstructedHome) -> Float[np.ndarray, "place 3"]:
    """Return the centers of the floor's cells, meters."""
    level = round((home.floor_m - home.volume.origin[1]) / home.volume.voxel_m)
    column = np.argwhere(home.marks[:, level] >= SUPPORTED)
    place = home.volume.origin[[0, 2]] + (column + 0.5) * home.volume.voxel_m
    return np.stack([place[:, 0], np.full(len(place), home.floor_m), place[:, 1]], axis=-1)


def _cut(data: BehaviorData, window: int) -> Trajectory:
    """Return the frames of a window as a recording, of which the past is valid."""
    track, start = recorded_at(data, window)
    part = slice(start, start + data.past + data.future)
    valid = np.arange(data.past + data.future) < data.past
    time_s = track.timestamp_s[part] - track.timestamp_s[start]
    poses = track.world_from_agent[part], track.agent_from_bone[part], track.world_from_camera[part]
    return Trajectory(time_s, *poses, valid)


def _placed(
    moments: Mapping[str, Trajectory],
    owns: Mapping[str, ReconstructedHome],
    other: ReconstructedHome,
    scenes: Mapping[str, Scenes],
    floor: Float[np.ndarray, "place 3"],
    rng: np.random.Generator,
) -> dict[str, Trajectory] | None:
    """Move a moment of all animals to where their past is not in collision, the first to a random floor
    place; None if none is found.
    """
    first, past = next(iter(moments)), {name: int(each.valid.sum()) for name, each in moments.items()}
    now = {name: each.world_from_agent[past[name] - 1, :3, 3] for name, each in moments.items()}
    height = {name: owns[name].height_above_top(each, past[name]) for name, each in moments.items()}
    for _ in range(PLACE_DRAWS):
        turn = rigid.rotation_from_vector(np.array([0.0, rng.uniform(0, 2 * np.pi), 0.0]))
        target, moved = floor[rng.integers(len(floor))], {}
        for name, moment in moments.items():
            place = target + (turn @ (now[name] - now[first])) * [1.0, 0.0, 1.0] + [0.0, height[name], 0.0]
            moved[name] = rigid.make(turn, place - turn @ now[name])
            roots = moved[name] @ moment.world_from_agent[: past[name]]
            if scenes[name].inside_solid(roots[None, :, :3, 3], None).any():
                break
        else:
            camera = moved[first] @ moments[first].world_from_camera
            camera[:, 1, 3] = moments[first].world_from_camera[:, 1, 3] - owns[first].floor_m + other.floor_m
            eye = camera[past[first] - 1, :3, 3]
            on_floor = np.abs(floor[:, [0, 2]] - eye[[0, 2]]).max(1).min() <= other.volume.voxel_m / 2
            if on_floor or np.linalg.norm(eye - target) > PRESENT_M:
                return {
                    name: replace(
                        moment,
                        world_from_agent=moved[name] @ moment.world_from_agent,
                        world_from_camera=camera,
                    )
                    for name, moment in moments.items()
                }
    return None


def _unusable(what: str, where: Path) -> InputError:
    return InputError("SIM-011", what, str(where), "give a build of recordings in one home, with a floor")


def _other_version(what: str, where: Path) -> InputError:
    return InputError("ART-007", what, str(where), "build it again: make <agent>.behavior_data.redo")
