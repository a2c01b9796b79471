"""Make takes of every kind from finished artifacts."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.baselines.samplers import load_playable
from pipeline.behavior.config import PlanSamplingConfig, ReplanningConfig
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.simulator import Simulator
from pipeline.behavior.trajectories import BehaviorData, Trajectory
from pipeline.core import progress
from pipeline.core.errors import InputError, other_versions_refused
from pipeline.data import glb, ply
from pipeline.environments.other_home import MovedAnimal, ReconstructedHome, move_in
from pipeline.longterm import journeys
from pipeline.longterm.bodies import load_body
from pipeline.longterm.config import MotionOptimizationConfig
from pipeline.longterm.journeys import LongTermWorld
from pipeline.longterm.motion_synthesis import LongTerm
from pipeline.longterm.short_motions import BodyMotion
from pipeline.longterm.subgoals import Subgoal, move_into_scene, sample_visited_subgoals
from pipeline.longterm.surroundings import MotionScene
from stages.simulate import elsewhere, journey_files
from stages.simulate.chained_goals import chained_goals
from stages.simulate.config import Config
from stages.simulate.inputs import Inputs
from stages.simulate.live import LiveAppearance, LiveView
from stages.simulate.observers import UNKNOWN_OBSERVER_M, Observer, scripted
from stages.simulate.rollout import rollout, write_take
from stages.simulate.shared_home import ReplayedAnimal, SharedHome, rollout_of_all, write_takes

MOVED_M = 0.25
"""A sub-goal reached at a distance of more than this counts as moved."""
DEFAULT_OBSERVER_OFFSET_M = np.array([1.0, 1.4, 0.0])
"""Phone position relative to the animal's first position if the recording has no observer."""

PERSON = "person"
"""The observer among those who are perceived; no animal has this name (CAP-043)."""
UNINTERRUPTED = ReplanningConfig(observer_motion_ratio=np.inf, blend_frames=0)
"""Every plan is played to its end."""


@dataclass(frozen=True)
class FinishedTake:
    """A take that is ready to be written."""

    summary: str
    """One line about it."""
    write: Callable[[Path], None]


def of_behavior(inputs: Inputs, c: Config, device: str) -> FinishedTake:
    """Simulate the animal with a scripted observer; optimize the take if configured and possible."""
    data = BehaviorData.load(_required(inputs, "behavior_data"))
    if inputs.home is not None:
        return _elsewhere(inputs, inputs.home, data, c, device)
    scenes = Scenes.load(_required(inputs, "behavior_data"), data.videos)
    simulator = _simulator(inputs, data, scenes, _sampling(c), ReplanningConfig(), device)
    take = rollout(simulator, _observer(simulator, c), seconds=c.seconds, seed=c.seed)
    blocked = float(take.blocked.mean())
    summary = f"{c.seconds:g} s, {blocked:.1%} of the plans' frames outside the allowed space"
    if not (c.optimize and inputs.longterm and inputs.reconstruction):
        return FinishedTake(summary, lambda folder: write_take(folder, take))
    motion = BodyMotion(take.world_from_agent, take.agent_from_bone.astype(np.float64))
    motion, before, after = journeys.refine_at_rate(
        _world(inputs, data), take.timestamp_s, motion, MotionOptimizationConfig()
    )
    bones = motion.agent_from_bone.astype(np.float32)
    take = replace(take, world_from_agent=motion.world_from_agent, agent_from_bone=bones)
    summary += f"; deepest {100 * before.deepest_m:.1f} -> {100 * after.deepest_m:.1f} cm"
    summary += f", foot skate {100 * before.slide_m_s:.1f} -> {100 * after.slide_m_s:.1f} cm/s"

    def write(folder: Path) -> None:
        write_take(folder, take)
        journey_files.write_metrics(folder, before, after, seconds=c.seconds)

    return FinishedTake(summary, write)


def _elsewhere(inputs: Inputs, home: Path, data: BehaviorData, c: Config, device: str) -> FinishedTake:
    """Let the animal live in the home of another build."""
    own = _own_home(inputs, _required(inputs, "behavior_data"))
    moved = move_in({"": (own, data)}, ReconstructedHome.of_build(home))[""]
    simulator = _simulator(inputs, moved.data, moved.home.scenes(), _sampling(c), ReplanningConfig(), device)
    take = rollout(simulator, _observer(simulator, c), seconds=c.seconds, seed=c.seed)
    about = elsewhere.metrics(take, moved, home.name)

    def write(folder: Path) -> None:
        write_take(folder, take)
        elsewhere.write_home(folder, moved, about)

    summary = f"{c.seconds:g} s in the home of {home.name}: {elsewhere.summary(take, about)}"
    return FinishedTake(summary, write)


def of_home(inputs: Inputs, animals: Path, c: Config, device: str) -> FinishedTake:
    """Simulate all animals of a home together, there or in the home of another build.

    Raises InputError SIM-013 for unknown names or if no animal is left, ART-003 for an animal without model
    or windows, and for another build without surface.
    """
    names = _names(animals, c)
    sampling = {name: _sampling(c, names, name) for name in names}
    data = {name: BehaviorData.load(animals / name / "behavior_data") for name in names}
    moved: dict[str, MovedAnimal] = {}
    where = animals / names[0] if inputs.home is None else inputs.home
    if not (where / "reconstruction/scene.ply").is_file():
        raise InputError("ART-003", "has no reconstruction", str(where), "make <agent>.reconstruction")
    if inputs.home is not None:
        homes = {name: _own_home(inputs, animals / name / "behavior_data") for name in names}
        recorded = {name: (homes[name], data[name]) for name in names}
        moved = move_in(recorded, ReconstructedHome.of_build(inputs.home))
    living: dict[str, Simulator | ReplayedAnimal] = {}
    for name in names:
        if name in c.replayed:
            living[name] = ReplayedAnimal(data[name])
            continue
        own = replace(inputs, behavior=animals / name / "behavior")
        here = moved.get(name)
        mine = here.data if here else data[name]
        scenes = here.home.scenes() if here else Scenes.load(animals / name / "behavior_data", mine.videos)
        living[name] = _simulator(own, mine, scenes, sampling[name], ReplanningConfig(), device)
    home = SharedHome(living)
    begun = home.reset(c.seed)[names[0]].world_from_agent[:3, 3]
    takes = rollout_of_all(home, _recorded_person(home.recording, begun, c), seconds=c.seconds, seed=c.seed)
    apart = np.linalg.norm(
        takes[names[0]].world_from_agent[:, :3, 3] - takes[names[-1]].world_from_agent[:, :3, 3], axis=-1
    )
    scene = ply.read_ply(where / "reconstruction/scene.ply")
    summary = f"{c.seconds:g} s of {', '.join(names)}"
    summary += f", {apart.min():.2f} m apart at least" if len(names) == 2 else ""
    about = {name: elsewhere.metrics(takes[name], here, where.name) for name, here in moved.items()}
    for name, each in about.items():
        summary += f"; {name}: {elsewhere.summary(takes[name], each)}"

    def write(folder: Path) -> None:
        write_takes(folder, takes, scene)
        for name, here in moved.items():
            elsewhere.write_home(folder / name, here, about[name])

    return FinishedTake(summary, write)


def _names(animals: Path, c: Config) -> list[str]:
    """Return the animals that are there, checked as `of_home` says."""
    known = sorted(path.name for path in animals.iterdir() if path.is_dir())
    unknown = sorted({*c.absent, *c.replayed} - set(known))
    names = [name for name in known if name not in c.absent]
    if unknown or not names:
        what = f"there is no animal {unknown[0]!r}" if unknown else "nobody is left"
        raise InputError("SIM-013", what, str(animals), f"known: {', '.join(known)}")
    for name in names:
        needed = ("reconstruction", "behavior_data", *(() if name in c.replayed else ("behavior",)))
        for artifact in needed:
            if not (animals / name / artifact / "manifest.json").is_file():
                remedy = f"make it: make <agent>.{artifact}; or leave {name} out"
                raise InputError("ART-003", f"{name} has no {artifact}", str(animals), remedy)
    return names


def _own_home(inputs: Inputs, behavior_data: Path) -> ReconstructedHome:
    shared = (_required(inputs, name) for name in ("feature_basis", "scene_template"))
    return ReconstructedHome.load(behavior_data, *shared)


def live(inputs: Inputs, c: Config, device: str) -> FinishedTake:
    """Let the animal live in a browser until interrupted."""
    data, shown = BehaviorData.load(_required(inputs, "behavior_data")), _required(inputs, "simulator")
    scenes = Scenes.load(_required(inputs, "behavior_data"), data.videos)
    simulator = _simulator(inputs, data, scenes, _sampling(c), ReplanningConfig(), device)
    with other_versions_refused("simulator", str(shown)):
        mesh, skin, _ = glb.read_skinned((shown / "agent.glb").read_bytes())
        look = LiveAppearance(mesh, skin, (shown / "scene.glb").read_bytes())
    seen = np.concatenate([t.world_from_camera[t.valid, :3, 3] for t in data.trajectories.values()])
    here = LiveView(simulator, look, np.median(seen, axis=0), seed=c.seed, port=c.port)
    progress.log(f"open http://127.0.0.1:{here.port} and drag the person; Ctrl-C ends it and keeps the take")
    take = here.run()
    return FinishedTake(f"{take.timestamp_s[-1]:g} s lived", lambda folder: write_take(folder, take))


def through_subgoals(inputs: Inputs, written: list[Subgoal] | None, c: Config, device: str) -> FinishedTake:
    """Let the animal travel through sub-goals, given or drawn."""
    data = BehaviorData.load(_required(inputs, "behavior_data"))
    world, rng = _world(inputs, data), np.random.default_rng(c.seed)
    if written is not None:
        subgoals = written
    elif c.places == "behavior":
        scenes = Scenes.load(_required(inputs, "behavior_data"), data.videos)
        simulator = _simulator(inputs, data, scenes, _sampling(c), UNINTERRUPTED, device)
        drawn = chained_goals(simulator, _observer(simulator, c), c.place_count, c.seed)
        subgoals = move_into_scene(drawn, world.scene, world.model.motion_prior)
    else:
        been = np.concatenate([each.world_from_agent[each.valid, :3, 3] for each in data.training.values()])
        subgoals = sample_visited_subgoals(been, c.place_count + 1, rng)
    made = journeys.travel(world, subgoals, MotionOptimizationConfig() if c.optimize else None, rng)
    asked = np.stack([goal.position_world for goal in subgoals])
    moved = int((np.nan_to_num(np.abs(asked - made.subgoals_world)).max(1) > MOVED_M).sum())

    def write(folder: Path) -> None:
        journey_files.write_journey(folder, made, world.body)
        if c.pictures_per_s > 0:
            scene = ply.read_ply(_required(inputs, "reconstruction") / "scene.ply")
            journey_files.write_frames(folder, made.motion, world.body, scene, rate_hz=c.pictures_per_s)

    metrics = made.after
    summary = f"{made.timestamp_s[-1]:.0f} s through {len(subgoals)} sub-goals; "
    summary += f"{metrics.non_collision:.2%} free of collision, {metrics.contact:.1%} in contact, "
    summary += f"foot skate {100 * metrics.slide_m_s:.1f} cm/s, "
    summary += f"largest seam {100 * made.largest_seam_m:.1f} cm"
    summary += f"; {moved} sub-goals moved to where it can be: take.json holds where to" if moved else ""
    return FinishedTake(summary, write)


def _world(inputs: Inputs, data: BehaviorData) -> LongTermWorld:
    model = LongTerm.load(_required(inputs, "longterm"))
    reconstruction = _required(inputs, "reconstruction")
    scene = MotionScene.reconstructed(reconstruction, data.trajectories.values())
    return LongTermWorld(model, load_body(reconstruction), scene)


def _simulator(
    inputs: Inputs,
    data: BehaviorData,
    scenes: Scenes,
    sampling: PlanSamplingConfig,
    chaining: ReplanningConfig,
    device: str,
) -> Simulator:
    sampler, ego = load_playable(_required(inputs, "behavior"), device)
    return Simulator(sampler, data, scenes, ego, sampling=sampling, chaining=chaining)


def _sampling(c: Config, animals: Sequence[str] = (), name: str = "") -> PlanSamplingConfig:
    """Return how an animal plans, the one with this name where several ``animals`` live together."""
    scales = guidance_scales(c.guidance, animals)
    of_others = tuple(scales[other] for other in animals if other != name)
    return PlanSamplingConfig(None, c.goal_steps, c.sequence_steps, scales[PERSON], of_others)


def guidance_scales(written: Sequence[str], animals: Sequence[str]) -> dict[str, float]:
    """Return the guidance scale of the person and of each of the ``animals``, as ``written`` (`NAME=SCALE`)
    or the default. Raises InputError SIM-013 for a name that nobody perceives, and where there is no scale.
    """
    scales = {PERSON: PlanSamplingConfig.guidance}
    scales |= {name: 1.0 for name in animals if len(animals) > 1}
    for each in written:
        name, _, text = each.partition("=")
        if name not in scales:
            what, remedy = f"nobody perceives {name!r}", f"known: {', '.join(sorted(scales))}"
            raise InputError("SIM-013", what, "guidance", remedy)
        try:
            scales[name] = float(text)
        except ValueError:
            scales[name] = np.nan
        if not 0 <= scales[name] < np.inf:
            remedy = f"write NAME=SCALE, such as {name}=1.5"
            raise InputError("SIM-013", f"{each!r} gives no scale from 0 up", "guidance", remedy)
    return scales


def _observer(simulator: Simulator, c: Config) -> Observer:
    """Return the scripted observer, centered where the recording's observer was, else beside the animal."""
    begin = simulator.reset(c.seed).world_from_agent[:3, 3]
    return _recorded_person(simulator.recording, begin, c)


def _recorded_person(track: Trajectory, begin: Float[np.ndarray, "3"], c: Config) -> Observer:
    seen, been = (poses[track.valid, :3, 3] for poses in (track.world_from_camera, track.world_from_agent))
    known = seen[np.linalg.norm(seen - been, axis=-1) < UNKNOWN_OBSERVER_M]
    center = np.median(known, axis=0) if len(known) else begin + DEFAULT_OBSERVER_OFFSET_M
    return scripted(c.observer, center=center, speed_m_s=c.observer_speed_m_s)


def _required(inputs: Inputs, name: str) -> Path:
    path = getattr(inputs, name)
    if path is None:
        remedy = f"give --{name.replace('_', '-')}"
        raise InputError("SIM-004", f"this take needs {name}", "stages.simulate", remedy)
    return path
