"""Time that simulated animals spend unsupported, outside of the home and in solids, with holes in the observed floor.

    python -m benchmarks.support build/cat [--home build/toy] [--plans simulate] [--lives 16] [--seconds 20]

Animals perceive, and plan in, a home of whose floor a part was not observed: none, 20 % and 40 % in patches of 0.5 m,
or one half. `slice_behavior` fills it. They are judged in the whole home: unsupported are frames in which no part of
the body is less than a voxel further above a surface below it than usual in the recordings. A person wanders and approaches by turns. The first line of a
table is the recorded motion. With ``--home`` the animal lives in the home of another build, which has the holes.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float

from benchmarks import command_lines
from pipeline.behavior.config import PlanSamplingConfig, ReplanningConfig
from pipeline.behavior.model import bones_from_channels
from pipeline.behavior.perception import FeatureVolume
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.support import SUPPORTED, floor_level
from pipeline.behavior.trajectories import RATE_HZ, BehaviorData
from pipeline.core.errors import InputError
from pipeline.data import npz
from pipeline.environments.config import EnvironmentConfig
from pipeline.environments.homes import Habitat
from pipeline.environments.other_home import ReconstructedHome, move_in
from pipeline.environments.residents import Resident, folders_of
from pipeline.environments.world import AnimalWorld, seen_from
from pipeline.longterm.bodies import PosedSurface, load_body
from stages.slice_behavior.windows import write_volumes

PATCH_VOXELS = 5
HOLES = {"none": 0.0, "20 %": 0.2, "40 %": 0.4, "half": 0.5}
VERTICES = 300
"""Vertices of a body that are judged."""
TURN_S = 4.0
"""Time after which a person begins, or ceases, to approach the animal."""


class SimulateConfig(EnvironmentConfig):
    """Plans as `simulate` draws them."""

    sampling = property(lambda self: PlanSamplingConfig())  # pyright: ignore
    chaining = property(lambda self: ReplanningConfig())  # pyright: ignore


def with_holes(home: Path, holes: str, out: Path) -> Path:
    """Slice a `behavior_data` anew as if a part of its floor was not observed."""
    data, volume = BehaviorData.load(home), FeatureVolume.load(home / "volume.npz")
    supported = npz.load(home / "volume.npz")["allowed"] >= SUPPORTED
    level = floor_level(supported)
    assert level is not None, "a home has a floor"
    floor = supported[:, level - 1 : level + 2].any(1)
    hole = floor & holes_in(floor, holes)
    occupancy, features = volume.occupancy.copy(), volume.features.copy()
    unseen = (occupancy == 1) & hole[:, None] & (np.arange(occupancy.shape[1]) <= level)[:, None]
    occupancy[unseen], features[:, unseen] = 2, 0
    out.mkdir()
    data.save(out)
    seen = replace(volume, occupancy=occupancy, features=features)
    write_volumes(out, (seen,), data.training, data.videos, RATE_HZ)
    return out


def holes_in(floor: Bool[np.ndarray, "x z"], holes: str) -> Bool[np.ndarray, "x z"]:
    """Choose columns of the floor that were not observed."""
    if holes == "half":
        return np.arange(len(floor))[:, None] < np.median(np.nonzero(floor)[0]) + 0 * floor
    rng = np.random.default_rng(0)
    tiles = rng.random([-(-size // PATCH_VOXELS) for size in floor.shape]) < HOLES[holes]
    return np.kron(tiles, np.ones((PATCH_VOXELS, PATCH_VOXELS), bool))[: floor.shape[0], : floor.shape[1]]


Poses = tuple[Float[np.ndarray, "frame 4 4"], Float[np.ndarray, "frame bone 4 4"]]
"""Roots in the world, and bones of the agent."""


class Judge:
    """Judges poses in a whole home."""

    def __init__(self, home: Path, own: Path):
        """``home`` is a `behavior_data`, ``own`` the folder of the animal."""
        table, self.volume = npz.load(home / "volume.npz"), FeatureVolume.load(home / "volume.npz")
        self.marks, solid = table["allowed"], self.volume.occupancy == 1
        self.level = level = floor_level(self.marks >= SUPPORTED)
        assert level is not None, "a home has a floor"
        number = np.arange(self.marks.shape[1])[:, None] + 1
        # floor that rises by a voxel is noise of the map, and sides of furniture carry nobody
        above = solid & ~np.roll(solid, -1, axis=1) & (number > level + 1)
        top = np.maximum.accumulate(np.where(above, number, level), axis=1)
        self.top_m = self.volume.origin[1] + top * self.volume.voxel_m
        body = load_body(own / "reconstruction")
        self.surface = PosedSurface(body, body.sample_vertices(VERTICES))

    def above_m(self, poses: Poses) -> Float[np.ndarray, "frame"]:
        """Return the smallest height of a part of the body above the surface below it."""
        with torch.inference_mode():
            points = self.surface(*(torch.from_numpy(each).float() for each in poses)).numpy()
        voxel, _ = self.volume.voxel(points)
        return (points[..., 1] - self.top_m[tuple(np.moveaxis(voxel, -1, 0))]).min(1)

    def shares(self, poses: Poses, usual_m: float) -> Float[np.ndarray, "3"]:
        """Return the shares of frames unsupported, outside of the home, and with the root in solids."""
        root, inside = self.volume.voxel(poses[0][:, :3, 3])
        x, y, z = root.T
        solid = (self.volume.occupancy[x, y, z] == 1) & (self.marks[x, y, z] == 0) & (y > self.level + 1)
        outside = ~inside | ~(self.marks[x, :, z] > 0).any(1)
        unsupported = self.above_m(poses) > usual_m + self.volume.voxel_m
        return np.array([unsupported.mean(), outside.mean(), solid.mean()])


def recorded(data: BehaviorData) -> Poses:
    """Return all recorded poses."""
    tracks = data.trajectories.values()
    roots = np.concatenate([track.world_from_agent[track.valid] for track in tracks])
    return roots, np.concatenate([track.agent_from_bone[track.valid] for track in tracks])


def lived(world: AnimalWorld, lives: int, seconds: float) -> dict[str, Poses]:
    """Return the poses of all animals in all lives, whose persons wander and approach by turns."""
    rng = np.random.default_rng(0)
    world.begin(lives, rng)
    seen = {name: [batch.past[-1]] for name, batch in world.batches.items()}
    begin, most = rng.uniform(0, 2 * TURN_S, lives), world.config.turn_rad_s / RATE_HZ
    for frame in range(round(seconds * RATE_HZ)):
        wander = rng.uniform([-1.0, -0.5, -1.0], [1.0, 1.5, 1.0], (lives, 3))
        person = world.persons
        left, ahead = seen_from(world, world.target, person.position, person.heading)[:, :2].T
        turn = np.clip(np.arctan2(left, ahead) / most, -1, 1)
        approach = np.stack([0 * turn, np.ones(lives), turn], axis=-1)
        near = (frame / RATE_HZ + begin) % (2 * TURN_S) < TURN_S
        world.step(np.clip(np.where(near[:, None], approach, wander), -1, 1))
        for name, batch in world.batches.items():
            seen[name].append(batch.past[-1])
    rest = {name: batch.rest for name, batch in world.batches.items()}
    return {
        name: (
            np.concatenate([each.root[:, 0] for each in frames]),
            np.concatenate([bones_from_channels(each.bones[:, 0], rest[name]) for each in frames]),
        )
        for name, frames in seen.items()
    }


def main() -> None:
    """Print the shares of each animal for each kind of holes."""
    parser = command_lines.described(__doc__)
    parser.add_argument("build", type=Path)
    parser.add_argument("--home", type=Path)
    parser.add_argument("--plans", choices=("environment", "simulate"), default="environment")
    parser.add_argument("--lives", type=int, default=16)
    parser.add_argument("--seconds", type=float, default=20.0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    config = EnvironmentConfig() if arguments.plans == "environment" else SimulateConfig()
    folders = {name: each for name, each in folders_of(arguments.build, None).items() if each is not None}
    homes = {name: (arguments.home or each) / "behavior_data" for name, each in folders.items()}
    judges = {name: Judge(homes[name], each) for name, each in folders.items()}
    residents = {name: Resident.load(each) for name, each in folders.items()}
    print("| holes | animal | unsupported | outside | in solids |\n|---|---|---|---|---|")

    def row(holes: str, name: str, poses: Poses) -> None:
        shares = judges[name].shares(poses, usual_m[name])
        print(f"| {holes} | {name} | " + " | ".join(f"{share:.2%}" for share in shares) + " |", flush=True)

    usual_m = {}
    for name, each in folders.items():
        poses = recorded(residents[name].habitat.data)
        usual_m[name] = float(np.median(Judge(each / "behavior_data", each).above_m(poses)))
        if not arguments.home:
            row("recorded", name, poses)
    for holes in HOLES:
        with tempfile.TemporaryDirectory() as scratch:
            seen = {name: with_holes(home, holes, Path(scratch) / name) for name, home in homes.items()}
            try:
                world = opened(arguments.build, arguments.home, residents, seen, config)
            except InputError as error:
                print(f"| {holes} | refused: {error} | | | |", flush=True)
                continue
            for name, poses in lived(world, arguments.lives, arguments.seconds).items():
                row(holes, name, poses)


def opened(
    build: Path,
    home: Path | None,
    residents: dict[str, Resident],
    seen: dict[str, Path],
    config: EnvironmentConfig,
) -> AnimalWorld:
    """Return the world of animals in homes as they were observed. Raises SIM-011 where one carries no animal."""
    if home is None:
        world = AnimalWorld(residents, config)
        for name, batch in world.batches.items():
            batch.scenes = Scenes.load(seen[name], residents[name].habitat.data.videos)
        return world
    [(name, resident)], [observed] = residents.items(), seen.values()
    other = ReconstructedHome.load(observed, home / "feature_basis", home / "scene_template")
    own = ReconstructedHome.of_build(build)
    moved = move_in({name: (own, resident.habitat.data)}, other)[name]
    habitat = Habitat.of_one_home(moved.data, moved.home.scenes(), moved.share_known)
    return AnimalWorld({name: replace(resident, habitat=habitat)}, config)


if __name__ == "__main__":
    main()
