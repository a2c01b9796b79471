"""Takes of both kinds, from finished artifacts to something that can be written."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from safetensors import SafetensorError

from pipeline import progress
from pipeline.errors import InputError
from pipeline.files import glb, meshes
from pipeline.models import behavior, journeys
from pipeline.models.bodies import load_body
from pipeline.models.journeys import World
from pipeline.models.motion_synthesis import LongTerm
from pipeline.models.planning import Sampler, TorchNetworks
from pipeline.models.scenes import Scenes
from pipeline.models.short_motions import RATE_HZ, Moving, stretches
from pipeline.models.simulator import Simulator
from pipeline.models.subgoals import Subgoal, brought_in, preferred
from pipeline.models.surroundings import Surroundings
from pipeline.models.trajectories import TRAIN, BehaviorData
from stages.simulate import journey_files
from stages.simulate.chained_goals import chained_goals
from stages.simulate.live import Live, Look
from stages.simulate.observers import AWAY_M, Observer, scripted
from stages.simulate.rollout import rollout, write_take

T = TypeVar("T")
Places = Literal["none", "visited", "behavior"]
MOVED_M = 0.25
"""A sub-goal that is met further off than this counts as moved."""
BESIDE_M = np.array([1.0, 1.4, 0.0])
"""Where a phone is held of whose observer nothing is known, from the animal's first position."""


@dataclass(frozen=True)
class Made:
    """A take that is ready to be written."""

    said: str
    """One line about it."""
    write: Callable[[Path], None]


def of_behavior(given: Mapping[str, Path], c: Any, device: str) -> Made:
    """Let the animal live beside a scripted observer; make the take physical where that is asked for and possible."""
    data = BehaviorData.load(_needed(given, "behavior_data"))
    simulator = _simulator(given, data, c, c.chaining, device)
    take = rollout(simulator, _observer(simulator, c), seconds=c.seconds, seed=c.seed)
    said = f"{c.seconds:g} s, {float(take.blocked.mean()):.1%} of the plans' frames outside the allowed space"
    if not (c.optimise and "longterm" in given and "reconstruction" in given):
        return Made(said, lambda folder: write_take(folder, take))
    motion = Moving(take.world_from_agent, take.agent_from_bone.astype(np.float64))
    motion, before, after = journeys.physical(_world(given, data), take.timestamp_s, motion, c.optimisation)
    take = replace(take, world_from_agent=motion.world_from_agent, agent_from_bone=motion.agent_from_bone.astype(np.float32))
    said += f"; deepest {100 * before.deepest_m:.1f} -> {100 * after.deepest_m:.1f} cm, slide {100 * before.slide_m_s:.1f} -> {100 * after.slide_m_s:.1f} cm/s"

    def write(folder: Path) -> None:
        write_take(folder, take)
        journey_files.write_worth(folder, before, after, seconds=c.seconds)

    return Made(said, write)


def of_recording(given: Mapping[str, Path], c: Any) -> Made:
    """Make reconstructed motion physical: the longest stretch of a session, at most as long as a take."""
    data = BehaviorData.load(_needed(given, "behavior_data"))
    if c.recording not in data.trajectories:
        raise InputError(
            "SIM-005", f"there is no motion of {c.recording!r}", str(given["behavior_data"]), f"known: {', '.join(data.videos)}"
        )
    found = stretches(data.trajectories[c.recording], shortest_s=0.5)
    if not found:
        raise InputError("SIM-005", f"{c.recording} holds no uninterrupted motion", str(given["behavior_data"]), "take another session")
    world, raw = _world(given, data), max(found, key=len)[: round(c.seconds * RATE_HZ) + 1]
    made = journeys.stayed(world, raw, c.optimisation if c.optimise else None)
    said = f"{c.recording}: {made.timestamp_s[-1]:.1f} s; penetration {1000 * made.before.penetration_m:.2f} -> {1000 * made.after.penetration_m:.2f} mm"
    return Made(said, lambda folder: journey_files.write_journey(folder, made, world.body))


def live(given: Mapping[str, Path], c: Any, device: str) -> Made:
    """Let the animal live in a browser until interrupted."""
    data, shown = BehaviorData.load(_needed(given, "behavior_data")), _needed(given, "simulator")
    simulator = _simulator(given, data, c, c.chaining, device)
    mesh, skin, _ = glb.read_skinned((shown / "agent.glb").read_bytes())
    look = Look(mesh, skin, (shown / "scene.glb").read_bytes())
    seen = np.concatenate([t.world_from_camera[t.valid, :3, 3] for t in data.trajectories.values()])
    here = Live(simulator, look, np.median(seen, axis=0), seed=c.seed, port=c.port)
    progress.log(f"open http://127.0.0.1:{here.port} and drag the person; Ctrl-C ends it and keeps the take")
    take = here.run()
    return Made(f"{take.timestamp_s[-1]:g} s lived", lambda folder: write_take(folder, take))


def through_subgoals(given: Mapping[str, Path], written: list[Subgoal] | None, c: Any, device: str) -> Made:
    """Let the animal travel through sub-goals, given or drawn."""
    data = BehaviorData.load(_needed(given, "behavior_data"))
    world, rng = _world(given, data), np.random.default_rng(c.seed)
    if written is not None:
        subgoals = written
    elif c.places == "behavior":
        simulator = _simulator(given, data, c, replace(c.chaining, noticeable=np.inf, fade_frames=0), device)
        drawn = chained_goals(simulator, _observer(simulator, c), c.place_count, c.seed)
        subgoals = brought_in(drawn, world.scene, world.model.habits)
    else:
        learned = [data.trajectories[data.videos[video]] for video in np.unique(data.video[data.split == TRAIN])]
        been = np.concatenate([trajectory.world_from_agent[trajectory.valid, :3, 3] for trajectory in learned])
        subgoals = preferred(been, c.place_count + 1, rng)
    made = journeys.travel(world, subgoals, c.optimisation if c.optimise else None, rng)
    asked = np.stack([goal.position_world for goal in subgoals])
    moved = int((np.nan_to_num(np.abs(asked - made.subgoals_world)).max(1) > MOVED_M).sum())

    def write(folder: Path) -> None:
        journey_files.write_journey(folder, made, world.body)
        if c.pictures_per_s > 0:
            scene = meshes.read_ply(given["reconstruction"] / "scene.ply")
            journey_files.write_frames(folder, made.moving, world.body, scene, rate_hz=c.pictures_per_s)

    worth = made.after
    said = f"{made.timestamp_s[-1]:.0f} s through {len(subgoals)} sub-goals; {worth.non_collision:.2%} free of collision, "
    said += f"{worth.contact:.1%} in contact, feet slide {100 * worth.slide_m_s:.1f} cm/s, largest seam {100 * made.largest_seam_m:.1f} cm"
    said += f"; {moved} sub-goals moved to where the animal can be: take.json tells where to" if moved else ""
    return Made(said, write)


def _world(given: Mapping[str, Path], data: BehaviorData) -> World:
    model, reconstruction = _loaded(LongTerm.load, _needed(given, "longterm")), _needed(given, "reconstruction")
    roots = np.concatenate([trajectory.world_from_agent[trajectory.valid, :3, 3] for trajectory in data.trajectories.values()])
    scene = Surroundings.for_motion(meshes.read_ply(reconstruction / "scene.ply"), roots)
    return World(model, load_body(reconstruction), scene)


def _simulator(given: Mapping[str, Path], data: BehaviorData, c: Any, chaining: Any, device: str) -> Simulator:
    architecture, nets, scaling, schedule, _ = _loaded(behavior.load, _needed(given, "behavior"))
    if architecture.family != "diffusion":
        what = f"plans of the family {architecture.family} cannot be chained"
        raise InputError("SIM-006", what, str(given["behavior"]), "give a model of the family diffusion")
    sampler = Sampler(TorchNetworks(nets, device), schedule, scaling)
    scenes = Scenes.load(given["behavior_data"], data.videos)
    return Simulator(sampler, data, scenes, architecture.ego, sampling=c.sampling, chaining=chaining)


def _loaded(load: Callable[[Path], T], folder: Path) -> T:
    """Load a trained model; by hand any may be given, so one that another version wrote is told as such."""
    try:
        return load(folder)
    except (OSError, KeyError, TypeError, ValueError, RuntimeError, SafetensorError) as error:
        what = f"is no model as this version writes it ({type(error).__name__}: {' '.join(str(error).split())[:120]})"
        raise InputError("ART-007", what, str(folder), "build it again with this version: make <agent>.<artifact>.redo") from error


def _observer(simulator: Simulator, c: Any) -> Observer:
    """Return a person about where one stood in the recording that the life begins in; beside the animal where nobody is known of."""
    begin = simulator.reset(c.seed).world_from_agent[:3, 3]
    track = simulator.recording
    seen, been = (poses[track.valid, :3, 3] for poses in (track.world_from_camera, track.world_from_agent))
    known = seen[np.linalg.norm(seen - been, axis=-1) < AWAY_M]
    center = np.median(known, axis=0) if len(known) else begin + BESIDE_M
    return scripted(c.observer, center=center, speed_m_s=c.observer_speed_m_s)


def _needed(given: Mapping[str, Path], name: str) -> Path:
    if name not in given:
        raise InputError("SIM-004", f"this take needs {name}", "stages.simulate", f"give --{name.replace('_', '-')}")
    return given[name]
