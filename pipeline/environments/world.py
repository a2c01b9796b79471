"""A batch of lives, each of a person and all animals of a home, that plan together and restart independently.

`AnimalWorld.load` opens a build, `begin` starts lives, `restart` some, `step` advances all by 0.1 s. Actions
move persons; behavior models move animals, each through an `AnimalBatch` of its own, which replans only when
a plan ends or someone perceived has moved noticeably, at the rate `plans_per_step`. The animals of a life
perceive each other. What a person meets is one of them, the ``target``: `animals` and `habitat` are its.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.behavior.model import bones_from_channels
from pipeline.behavior.simulator import AnimalBatch
from pipeline.behavior.trajectories import RATE_HZ, TEST, TRAIN, Context
from pipeline.core import devices, threads
from pipeline.core.arguments import checked_numbers
from pipeline.core.config import from_table
from pipeline.core.errors import InputError
from pipeline.environments.config import EnvironmentConfig
from pipeline.environments.floor import PersonFloor, to_local, to_world
from pipeline.environments.homes import Habitat
from pipeline.environments.moments import moments_together
from pipeline.environments.residents import Resident, companions_of, folders_of
from pipeline.environments.rewards import ENDING, REWARDS, StepOutcome
from pipeline.environments.rgbd import RgbdCamera
from pipeline.metrics.flight import flees

EYE_M = 1.4
"""Height of a person's phone above the floor, meters."""
CLOSE_M = 2.4
"""Distance from the person within which an animal that moves away counts as fleeing."""
FLIGHT_S = 1.5
"""Duration in which it must get away: of what does in 3 s, 30 % only walk on (built-in cat, by its rule)."""
START_DRAWS = 30
"""Places tried for a person's start before a blocked one is accepted."""
SPLITS = {"train": TRAIN, "test": TEST}


@dataclass
class Persons:
    """Where the persons are; rows are replaced when an episode begins."""

    position: Float[np.ndarray, "person 2"]
    """World x and z, meters."""
    heading: Float[np.ndarray, "person"]
    """About world +y, radians; 0 looks along +z."""
    velocity: Float[np.ndarray, "person 2"]
    """World x and z, m/s."""


class AnimalWorld:
    """Lives of a person and the animals of a home, each in the scene of a recording of the target."""

    def __init__(self, residents: Mapping[str, Resident | None], config: EnvironmentConfig):
        """``residents`` are the animals of the home by name, None if absent."""
        self.config, self.names = config, tuple(residents)
        self.residents = {name: each for name, each in residents.items() if each is not None}
        self.target = config.animal or next(iter(self.residents))
        self.batches = {name: each.batch(config) for name, each in self.residents.items()}
        self.camera: RgbdCamera | None = None
        data, scenes = self.habitat.data, self.habitat.scenes
        tracks = [data.trajectories[name] for name in data.videos]
        roots = [track.world_from_agent[track.valid, :3, 3] for track in tracks]
        self.floors, scene_of = [], scenes.number(np.arange(len(roots)), len(roots)).tolist()
        for number, volume in enumerate(scenes.volumes):
            here = [root for root, scene in zip(roots, scene_of, strict=True) if scene == number]
            self.floors.append(PersonFloor.of(volume, np.concatenate(here)))

    @classmethod
    def opened(
        cls,
        build: "str | Path | AnimalWorld",
        *,
        home: str | Path | None = None,
        homes: str | Path | Sequence[str | Path] = (),
        device: str = "cpu",
        config: EnvironmentConfig | None = None,
        **settings: Any,
    ) -> "AnimalWorld":
        """Return the world of a build, or the one given, its animals in another build's home where ``home``
        names one, or in each of ``homes``: every episode draws one of them.

        ``settings`` replace fields of ``config``.
        """
        several = [homes] if isinstance(homes, str | Path) else homes
        given = [Path(each) for each in (home, *several) if each is not None]
        if isinstance(build, AnimalWorld):
            assert not (given or config or settings), "a world that is open has its homes and settings"
            return build
        config = from_table(EnvironmentConfig, settings, where="environment", base=config)
        return cls.load(Path(build), config, homes=given, device=devices.choose(device))

    @classmethod
    @threads.single_threaded()  # forked processes hang in PyTorch's threads
    def load(
        cls, build: Path, config: EnvironmentConfig, *, homes: Sequence[Path] = (), device: str = "cpu"
    ) -> "AnimalWorld":
        """Open a finished build with all animals of its home, in ``homes`` where there are any.

        Raises what `Resident.load_all` and `folders_of` raise, and ART-003 where surfaces that `rgbd` shows
        are lacking.
        """
        folders = folders_of(build, config.animal)
        bodies = {name: folder for name, folder in folders.items() if folder is not None}
        target = config.animal or next(iter(bodies))
        leading = {target: bodies[target]} | bodies
        residents = Resident.load_all(build, leading, homes=homes, device=device)
        world = cls({name: residents.get(name) for name in folders}, config)
        if "rgbd" in config.observations:
            shown = [bodies[target] if home.resolve() == build.resolve() else home for home in homes]
            world.camera = RgbdCamera.load(list(bodies.values()), shown or [bodies[target]])
        return world

    @threads.single_threaded()
    def begin(self, count: int, rng: np.random.Generator, split: str = "train") -> None:
        """Begin ``count`` lives; ``rng`` draws windows, starts and all plans from here on."""
        self._windows(split)
        self.rng, self.steps = rng, 0
        self.persons = Persons(np.zeros((count, 2)), np.zeros(count), np.zeros((count, 2)))
        self.video = np.zeros(count, int)
        for name, context in self._drawn(np.arange(count), split).items():
            self.batches[name].begin(context, rng, companions=context.companions)

    @threads.single_threaded()
    def restart(self, some: Int[np.ndarray, "some"], split: str = "train") -> None:
        """Begin some lives anew, by their indices."""
        for name, context in self._drawn(some, split).items():
            self.batches[name].restart(some, context)

    @threads.single_threaded()
    def step(self, action: Any) -> StepOutcome:
        """Move the persons by their actions (person x command, -1..1 of the highest speeds) and let the
        animals live for 0.1 s.

        Raises SIM-012 for actions that are no finite numbers, or not as many as there are.
        """
        before = self.distance_m
        self._walk(np.clip(checked(action, (len(before), self.action_size)), -1, 1))
        last = self.animal_position.copy()
        past = {name: batch.past_world for name, batch in self.batches.items()}
        for name, batch in self.batches.items():
            batch.step(self.eyes, companions_of(name, past))
        self.steps += len(before) * len(self.batches)
        moved = np.linalg.norm((self.animal_position - last)[:, [0, 2]], axis=-1)
        return StepOutcome(before, self.distance_m, moved * RATE_HZ, self.fleeing)

    def judge(
        self, outcome: StepOutcome, frame: int | Int[np.ndarray, "person"]
    ) -> tuple[Float[np.ndarray, "person"], Bool[np.ndarray, "person"], Bool[np.ndarray, "*person"]]:
        """Return rewards, whether the outcome ends the episode, and whether ``frame`` is its last one."""
        over = (outcome.reached | outcome.flees) & (self.config.reward in ENDING)
        late = np.asarray(frame) >= round(self.config.episode_s * RATE_HZ)
        return REWARDS[self.config.reward](outcome), over, late

    @property
    def animals(self) -> AnimalBatch:
        """The animals that persons meet, one per life."""
        return self.batches[self.target]

    @property
    def habitat(self) -> Habitat:
        """Where these live: recorded moments to begin from, and their scenes."""
        return self.residents[self.target].habitat

    @property
    def action_size(self) -> int:
        """Numbers of an action: ahead, left and turn of a person; ahead and turn of a robot."""
        return 3 if self.config.embodiment == "person" else 2

    @property
    def plans_per_step(self) -> float:
        """Plans drawn per animal and step since `begin`."""
        return sum(batch.plans_drawn for batch in self.batches.values()) / max(self.steps, 1)

    @property
    def animal_position(self) -> Float[np.ndarray, "animal 3"]:
        """World positions of the roots, meters."""
        return self.animals.past[-1].root[:, 0, :3, 3]

    @property
    def distance_m(self) -> Float[np.ndarray, "person"]:
        """Horizontal distance of person and animal, meters."""
        return self.distance_of_m(self.target)

    def distance_of_m(self, name: str) -> Float[np.ndarray, "person"]:
        """Return the persons' horizontal distances from any of the animals, meters."""
        root = self.batches[name].past[-1].root[:, 0]
        return np.linalg.norm(root[:, [0, 2], 3] - self.persons.position, axis=-1)

    @property
    def eyes(self) -> Float[np.ndarray, "person 3"]:
        """World positions that the animals perceive, meters."""
        x, z = self.persons.position.T
        height = np.array([self.floors[scene].floor_m for scene in self.scene]) + EYE_M
        return np.stack([x, height, z], axis=-1)

    @property
    def scene(self) -> Int[np.ndarray, "person"]:
        """Number of each life's scene."""
        return self.habitat.scenes.number(self.video, len(self.video))

    @property
    def home(self) -> Int[np.ndarray, "person"]:
        """Number of each life's home, in the order of `homes`."""
        return self.habitat.home_of_video[self.video]

    @property
    def share_known(self) -> Float[np.ndarray, "person"]:
        """How much (0..1) of each life's home looks like the one that the animal knows."""
        return self.share_known_of(self.target)

    def share_known_of(self, name: str) -> Float[np.ndarray, "person"]:
        """Return `share_known` of any of the animals."""
        return np.array(self.residents[name].habitat.share_known)[self.home]

    def pictures(self) -> list[tuple[UInt8[np.ndarray, "48 64 3"], Float[np.ndarray, "48 64"]]]:
        """Return what the persons' cameras see: color, and z-depth in meters (0 where nothing is)."""
        assert self.camera is not None, "a world that is seen is opened with `rgbd` among its observations"
        each = [(batch.past[-1], batch.rest) for batch in self.batches.values()]
        poses = [(now.root[:, 0], bones_from_channels(now.bones[:, 0], rest)) for now, rest in each]
        rows = enumerate(zip(self.home, self.eyes, self.persons.heading, strict=True))
        return [
            self.camera.picture(int(home), eye, heading, [(root[row], bones[row]) for root, bones in poses])
            for row, (home, eye, heading) in rows
        ]

    @property
    def fleeing(self) -> Bool[np.ndarray, "animal"]:
        """Whether a person is close and the rest of the animal's plan gets away by what counts as flight."""
        plan, played = self.animals.plan.root[..., :3, 3], self.animals.played
        frames = np.minimum(played[:, None] + np.arange(round(FLIGHT_S * RATE_HZ)), plan.shape[1] - 1)
        path = np.take_along_axis(plan, frames[..., None], axis=1)
        return (self.distance_m < CLOSE_M) & flees(path, self.animal_position, self.eyes)

    def _walk(self, action: Float[np.ndarray, "person command"]) -> None:
        """Move persons; at walls they slide along them."""
        persons, c = self.persons, self.config
        persons.heading = persons.heading + action[:, -1] * c.turn_rad_s / RATE_HZ
        left = action[:, 1] if self.action_size == 3 else np.zeros(len(action))
        wish = np.stack([left, action[:, 0]], axis=-1)
        wish = wish / np.maximum(np.linalg.norm(wish, axis=-1, keepdims=True), 1.0)
        step = to_world(wish, persons.heading) * c.speed_m_s / RATE_HZ
        begin = persons.position.copy()
        parts = max(2, int(np.ceil(c.speed_m_s / RATE_HZ / min(f.cell_m for f in self.floors))))
        for axes in ([1.0, 1.0], [1.0, 0.0], [0.0, 1.0]):
            stuck = (persons.position == begin).all(-1)
            target = begin + step * axes
            free = stuck & ~self._blocked(target)
            for share in np.arange(1, parts) / parts:  # a wall of one voxel is thinner than a step
                free &= ~self._blocked(begin + share * (target - begin))
            persons.position[free] = target[free]
        persons.velocity = (persons.position - begin) * RATE_HZ

    def _blocked(self, points: Float[np.ndarray, "person 2"]) -> Bool[np.ndarray, "person"]:
        blocked = np.zeros(len(points), bool)
        for number in np.unique(self.scene):
            mine = self.scene == number
            blocked[mine] = self.floors[number].blocks(points[mine])
        return blocked

    def _drawn(self, some: Int[np.ndarray, "some"], split: str) -> dict[str, Context]:
        """Draw each animal's windows for some lives, and where the persons have stood, facing the target."""
        data = {name: each.habitat.data for name, each in self.residents.items()}
        chosen = self._moments(len(some), split)
        home_of = {name: each.habitat.home_of_window for name, each in self.residents.items()}
        begun = [moments_together(data, self.target, int(each), SPLITS[split], home_of) for each in chosen]
        windows = {name: np.array([row[name] for row in begun]) for name in data}
        contexts = {name: data[name].windows(each)[0] for name, each in windows.items()}
        video = contexts[self.target].video
        assert video is not None, "windows of data always name their recording"
        self.video[some] = video
        past = {name: context.world_from_agent[..., :3, 3] for name, context in contexts.items()}
        for number, row in enumerate(some):
            here = {name: track[number, -1, [0, 2]] for name, track in past.items()}
            self.persons.position[row] = self._start(here, self.floors[self.scene[row]])
            ahead = here[self.target] - self.persons.position[row]
            self.persons.heading[row] = np.arctan2(ahead[0], ahead[1])
            self.persons.velocity[row] = 0.0
        observer = np.repeat(self.eyes[some][:, None], self.habitat.data.past, axis=1)
        seen: dict[str, Any] = {"observer_world": observer, "observer_rotation": None}
        return {
            name: replace(context, companions=companions_of(name, past), **seen)
            for name, context in contexts.items()
        }

    def _windows(self, split: Any) -> Int[np.ndarray, "window"]:
        """Return the windows of a split. Raises REC-002 where there are none."""
        windows = self.habitat.data.indices(SPLITS.get(split, -1) if isinstance(split, str) else -1)
        if not len(windows):
            raise InputError("REC-002", f"no window of the split {split!r}", "reset", "train or test")
        return windows

    def _moments(self, count: int, split: str) -> Int[np.ndarray, "some"]:
        """Draw windows; where there are several homes, each is as likely as another."""
        windows = self._windows(split)
        home = self.habitat.home_of_window[windows]
        homes = np.unique(home)
        if len(homes) == 1:
            return self.rng.choice(windows, count)
        drawn = self.rng.choice(homes, count)
        return np.array([self.rng.choice(windows[home == each]) for each in drawn])

    def _start(
        self, here: Mapping[str, Float[np.ndarray, "2"]], floor: PersonFloor
    ) -> Float[np.ndarray, "2"]:
        """Draw a free place around the target, on no other animal; if none is free, return the nearest."""
        near, far = sorted(self.config.start_m)
        animal = place = here[self.target]
        others = [(at, self.batches[name].clearance_m) for name, at in here.items() if name != self.target]
        for _ in range(START_DRAWS):
            angle, distance = self.rng.uniform(0, 2 * np.pi), self.rng.uniform(near, far)
            place = animal + distance * np.array([np.sin(angle), np.cos(angle)])
            apart = (np.linalg.norm(place - at) >= clearance_m for at, clearance_m in others)
            if not floor.blocks(place[None])[0] and all(apart):
                return place
        free = floor.corner + (np.argwhere(~floor.blocked) + 0.5) * floor.cell_m
        return free[np.linalg.norm(free - place, axis=1).argmin()] if len(free) else place


def checked(action: Any, shape: tuple[int, int]) -> Float[np.ndarray, "person command"]:
    """Return actions as numbers. Raises SIM-012 where they are not finite or of another shape."""
    remedy = "look for what made the policy diverge: learning rate, rewards, observations"
    return checked_numbers(action, shape, name="actions", remedy=remedy)


ANIMAL_NUMBERS = 7
"""Numbers of `seen_from`."""


def others_seen(
    world: AnimalWorld, name: str, place: Float[np.ndarray, "life 2"], heading: Float[np.ndarray, "life"]
) -> Float[np.ndarray, "life other 8"]:
    """Return all animals but one, by their names, as seen from places (world x and z, meters) and headings
    (radians): 1 and `seen_from`, or zeros for an animal that is absent.
    """
    others = np.zeros((len(place), len(world.names) - 1, 1 + ANIMAL_NUMBERS), np.float32)
    for column, other in enumerate(each for each in world.names if each != name):
        if other in world.batches:
            others[:, column, 0], others[:, column, 1:] = 1.0, seen_from(world, other, place, heading)
    return others


def seen_from(
    world: AnimalWorld, name: str, place: Float[np.ndarray, "life 2"], heading: Float[np.ndarray, "life"]
) -> Float[np.ndarray, "life 7"]:
    """Return an animal in the frames of places (world x and z, meters) and headings (radians): place (left,
    ahead), height above the floor (m), heading, velocity (m/s).
    """
    past = world.batches[name].past
    root, before = past[-1].root[:, 0], past[-2].root[:, 0, :3, 3]
    offset = to_local(root[:, [0, 2], 3] - place, heading)
    height = root[:, 1, 3] - np.array([world.floors[scene].floor_m for scene in world.scene])
    ahead = to_local(root[:, [0, 2], 2], heading)
    velocity = to_local((root[:, :3, 3] - before)[:, [0, 2]] * RATE_HZ, heading)
    return np.concatenate([offset, height[:, None], ahead, velocity], axis=-1).astype(np.float32)


def occupancy_seen(world: AnimalWorld) -> Float[np.ndarray, "person 16 16"]:
    """Return what blocks the way around each person, in its own frame."""
    position, heading = world.persons.position, world.persons.heading
    rows = [(scene, slice(row, row + 1)) for row, scene in enumerate(world.scene)]
    return np.concatenate([world.floors[scene].around(position[row], heading[row]) for scene, row in rows])
