"""Measure what a behavior model gains from perceiving another animal: the built-in dog alternately follows, plays with
and avoids the built-in cat.

    python -m benchmarks.social OUT --seeds 5

Simulates cat, dog and a person in furnished homes, some held out for testing, trains the behavior model of the dog,
and evaluates it on the same test windows with three perceptions of the cat: as it was, frozen at its current position,
and removed. Training drops companions from a tenth of the samples, so that none of the three is out of distribution.
Results that are in OUT already are reused.

Goals are scored as in the tables of the paper. Closed-loop rollouts of 28 s beside the recorded cat and person are
compared with the recorded dog: distance to the cat, collisions, and the fractions of its activities
(`classify_activity`). Bodies are not learned; the dog faces its direction of motion.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int

from benchmarks import command_lines
from benchmarks.behavior_builds import SESSION_S, TAKES, slice_sessions, train_model
from pipeline.baselines.predictors import Ats, LocationPrior, Samples
from pipeline.behavior.avoidance import clearance_of
from pipeline.behavior.config import PlanSamplingConfig, ReplanningConfig
from pipeline.behavior.model import ROOT_CHANNELS
from pipeline.behavior.planning import PlanCondition, Sampler
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.simulator import AnimalBatch
from pipeline.behavior.trajectories import (
    ABSENT_M,
    FUTURE,
    KINDS,
    PAST,
    RATE_HZ,
    TEST,
    TRAIN,
    BehaviorData,
    Context,
)
from pipeline.core.progress import log
from pipeline.core.videos import Split
from pipeline.data import npz
from pipeline.geometry import rigid
from pipeline.metrics.flight import flees
from pipeline.metrics.intervals import bootstrapped, episodes
from pipeline.metrics.scores import goal_energy_score, goal_minde
from stages.read_trajectories.motion import CLIP_GAP_S, MeasuredMotion
from stages.synthesize_capture import camera_motion, dwellings, gait, session
from stages.synthesize_capture.dog import DOG
from stages.synthesize_capture.lives.lives import rest
from stages.synthesize_capture.observer import AT_HOME
from stages.synthesize_capture.room import Room
from stages.synthesize_capture.voxels import volume_of
from stages.train_behavior.config import (
    AugmentationConfig,
    BehaviorOptimizerConfig,
    BehaviorTrainingConfig,
    ObjectiveConfig,
)
from stages.train_behavior.config import Config as TrainingConfig

MODEL = TrainingConfig(
    export=False,
    ensemble_size=1,
    training=BehaviorTrainingConfig(
        BehaviorOptimizerConfig(steps=2400, goal_steps=2000, goal_batch=128, rate=4e-3),
        AugmentationConfig(past=0.05, approached=0.25, approached_paths=0.5),
        ObjectiveConfig(weighting="flow", code_dropout=0.0, path_share=1.0, body_share=0.0),
    ),
)
"""As in `agents/benchmark.toml`, without bodies and with fewer steps for paths. Of 500, 2000 and 5000 steps of goals,
2000 have the least energy score in three homes chosen for this (0.796, 0.753 and 0.836 m)."""
PERCEIVED = ("as it is", "standing still", "not at all")
GOALS, GOAL_STRIDE = 16, 20
"""Samples per window, and stride of the evaluated test windows."""
ROLLOUT_FRAMES, ROLLOUT_STRIDE = 280, 3
"""Frames of a closed-loop rollout, two seconds less than a take; and stride of the simulated takes."""
ACTIVITY_STRIDE = 10
"""Frames between classified activities."""
NEAR_M, CHASE_M = 1.2, 1.1
"""Maximal distance to the cat after 5.6 s of a dog that stays with it (it follows at 0.95 m, plays at 0.75 m), and
distance within one second above which it plays (it follows at 0.9 m/s, plays at 1.5 m/s)."""
COLLISION_M = 0.45
"""Distance of centers below which bodies intersect: those of the synthetic world keep 0.62 m on the floor."""
HEADING_DECAY_M = 0.3
"""Distance over which the weight of a past heading decays to 1/e, about a body length."""
ACTIVITIES = ("follows", "plays", "avoids", "goes its own way")


@dataclass(frozen=True)
class ForwardFacingSampler(Sampler):
    """Samples goals and paths; the body is upright and faces its direction of motion."""

    def bodies(
        self, codes: PlanCondition, path: Float[np.ndarray, "plan frame 3"], rng: np.random.Generator
    ) -> Float[np.ndarray, "plan frame channel"]:
        """Return roots that turn along the path, starting with heading +z."""
        steps = np.diff(path, axis=1, prepend=codes.start[:, None])[..., ::2]
        facing = np.tile([0.0, 1.0], (len(path), 1))
        found = np.tile(self.scaling.body_mean, (*path.shape[:2], 1))
        for frame in range(path.shape[1]):
            step = steps[:, frame]
            facing = (
                facing * np.exp(-np.linalg.norm(step, axis=1, keepdims=True) / HEADING_DECAY_M)
                + step / HEADING_DECAY_M
            )
            facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-9)
            turn = np.pad(np.arctan2(*facing.T)[:, None], ((0, 0), (1, 1)))
            found[:, frame, :ROOT_CHANNELS] = rigid.rotation_to_6d(rigid.rotation_from_vector(turn))
        return found


@dataclass(frozen=True)
class RecordedTakes:
    """Recorded takes of dog, cat and person, from which closed-loop rollouts start."""

    context: Context
    path: Float[np.ndarray, "take frame 3"]
    """Recorded path of the dog."""
    cat: Float[np.ndarray, "take frame 4"]
    """Position and kind, including the past."""
    person: Float[np.ndarray, "take frame 3"]

    @classmethod
    def load(cls, data: BehaviorData) -> "RecordedTakes":
        """Load the first window of every `ROLLOUT_STRIDE`-th test take."""
        data = data.with_horizon(ROLLOUT_FRAMES)
        test = data.indices(TEST)
        begins = np.diff(data.start[test], prepend=-2) != 1
        selected = test[begins][::ROLLOUT_STRIDE]
        frames = data.start[selected][:, None] + np.arange(data.past + ROLLOUT_FRAMES)
        tracks = [data.trajectories[data.videos[video]] for video in data.video[selected]]
        cats = [track.companions for track in tracks if track.companions is not None]
        cat = np.stack([each[row, 0] for each, row in zip(cats, frames, strict=True)])
        person = [track.world_from_camera[row, :3, 3] for track, row in zip(tracks, frames, strict=True)]
        context, future = data.windows(selected)
        return cls(context, future.path_world, cat, np.stack(person))

    def rollout(self, ats: Ats, perception: str, seed: int) -> Float[np.ndarray, "take frame 3"]:
        """Simulate the dog beside the recorded cat and person and return its path, with one of the perceptions
        `PERCEIVED` of the cat; without any, it does not keep clear of the cat either.
        """
        scenes, own = ats.scenes, ats.sampler
        sampler = ForwardFacingSampler(own.networks, own.schedule, own.scaling)
        dogs = AnimalBatch(
            sampler,
            scenes,
            ats.agent_from_bone_rest,
            ats.ego,
            sampling=ats.sampling,
            chaining=ReplanningConfig(),
        )
        dogs.clearance_m = clearance_of(DOG.size * rest())
        context = replace(self.context, companions=self.cat_perceived(perception, 0))
        dogs.begin(context, np.random.default_rng(seed), companions=context.companions)
        found = []
        for frame in range(ROLLOUT_FRAMES):
            now = dogs.step(self.person[:, frame + PAST - 1], self.cat_perceived(perception, frame))
            found.append(now.root[:, 0, :3, 3])
        return np.stack(found, axis=1)

    def cat_perceived(self, perception: str, frame: int) -> Float[np.ndarray, "take 1 past 4"] | None:
        """Return the past of the cat at a frame of the rollouts; None if it is not perceived at all."""
        if perception == PERCEIVED[-1]:
            return None
        cat = self.cat[:, None, frame : frame + PAST]
        return with_perception(replace(self.context, companions=cat), perception).companions

    def statistics(self, path: Float[np.ndarray, "take frame 3"]) -> dict[str, Float[np.ndarray, "take"]]:
        """Return the mean distance to the cat and the fractions of time in collision and of each activity, per take."""
        cat = self.cat[:, PAST:, :3]
        apart = path - cat
        starts = np.arange(0, ROLLOUT_FRAMES - FUTURE, ACTIVITY_STRIDE)
        ahead = starts[:, None] + 1 + np.arange(FUTURE)
        activity = classify_activity(path[:, ahead], path[:, starts], cat[:, ahead], cat[:, starts])
        return {
            "distance, m": np.linalg.norm(apart[..., [0, 2]], axis=-1).mean(1),
            "in collision": (np.linalg.norm(apart, axis=-1) < COLLISION_M).mean(1),
        } | {name: (activity == number).mean(1) for number, name in enumerate(ACTIVITIES)}


def simulate_session(home: Room, rng: np.random.Generator) -> MeasuredMotion:
    """Simulate cat, dog and person in a home in several takes; the dog is the agent."""
    time = np.arange(round(SESSION_S / TAKES * RATE_HZ)) / RATE_HZ
    sample = np.round(time / session.STEP_S).astype(int)
    dog, cat, camera = [], [], []
    for _ in range(TAKES):
        take = session.simulate_session(home, rng, SESSION_S / TAKES, AT_HOME, with_dog=True)
        assert take.companion is not None
        dog.append(gait.poses(take.companion, time, DOG).world_from_agent)
        place = gait.poses(take.animal, time).world_from_agent[:, :3, 3]
        cat.append(np.pad(place, ((0, 0), (0, 1)), constant_values=KINDS.index("animal")))
        camera.append(camera_motion.filming(take, rng)[sample])
    clock = np.concatenate([time + number * (time[-1] + CLIP_GAP_S) for number in range(TAKES)])
    bones, rest = np.tile(np.eye(4), (len(clock), 1, 1, 1)), np.eye(4, dtype=np.float32)[None]
    motion = np.concatenate(dog), bones, np.concatenate(camera), rest
    return MeasuredMotion(clock, *motion, volume_of(home), np.concatenate(cat)[:, None])


def load_data(out: Path, homes: int, test_homes: int, test_sessions: int) -> tuple[BehaviorData, Scenes]:
    """Simulate sessions and slice them into windows."""

    def sessions() -> Iterator[tuple[str, Split, MeasuredMotion]]:
        for number in range(homes + test_homes):
            home = dwellings.furnish_otherwise(np.random.default_rng([0, 10, number]))
            for session_index in range(1 if number < homes else test_sessions):
                rng = np.random.default_rng([0, 13, number, session_index])
                motion = simulate_session(dwellings.rearranged(home, rng), rng)
                yield f"home{number}-{session_index}", "train" if number < homes else "test", motion

    sliced = out / "behavior_data"
    if not (sliced / "qa.json").is_file():
        slice_sessions(sessions(), out)
    data = BehaviorData.load(sliced)
    return data, Scenes.load(sliced, data.videos)


def open_model(out: Path, seed: int, scenes: Scenes) -> Ats:
    """Train one model, unless it exists, and open it."""
    model = train_model(out, replace(MODEL, seed=seed), f"behavior-{seed}")
    return Ats.load(model, scenes, PlanSamplingConfig())


def with_perception(context: Context, perception: str) -> Context:
    """Return windows with one of the perceptions `PERCEIVED` of the cat."""
    cat = context.companions
    assert cat is not None
    match perception:
        case "as it is":
            return context
        case "standing still":
            return replace(context, companions=np.repeat(cat[:, :, -1:], cat.shape[2], axis=2))
        case _:
            return replace(context, companions=np.where(np.arange(4) < 3, ABSENT_M, cat))


def classify_activity(
    path: Float[np.ndarray, "*moment frame 3"],
    now: Float[np.ndarray, "*moment 3"],
    cat: Float[np.ndarray, "*moment frame 3"],
    cat_now: Float[np.ndarray, "*moment 3"],
) -> Int[np.ndarray, "*moment"]:
    """Classify paths of 5.6 s as one of `ACTIVITIES`, given the path of the cat."""
    near = np.linalg.norm((path - cat)[..., -1, :][..., [0, 2]], axis=-1) < NEAR_M
    second = (path[..., RATE_HZ:, :] - path[..., :-RATE_HZ, :])[..., [0, 2]]
    covered = np.linalg.norm(second, axis=-1).max(-1)
    return np.select([near & (covered < CHASE_M), near, flees(path, now, cat_now)], [0, 1, 2], 3)


def sampled_goals(out: Path, seed: int, scenes: Scenes, context: Context) -> dict[str, np.ndarray]:
    """Return goals of a model for each perception, from the same noise; cached."""
    path = out / f"goals-{seed}.npz"
    if not path.is_file():
        ats = open_model(out, seed, scenes)
        shown = {perception: with_perception(context, perception) for perception in PERCEIVED}
        goals = {
            perception: ats.goals(seen, GOALS, np.random.default_rng(seed)).goal
            for perception, seen in shown.items()
        }
        npz.save(path, compress=False, **goals)
        log(f"seed {seed}: goals sampled")
    return npz.load(path)


def rollouts(out: Path, seed: int, scenes: Scenes, takes: RecordedTakes) -> dict[str, np.ndarray]:
    """Return rollouts of a model for each perception; cached."""
    path = out / f"lives-{seed}.npz"
    found = npz.load(path) if path.is_file() else {}
    if missing := [perception for perception in PERCEIVED if perception not in found]:
        ats = open_model(out, seed, scenes)
        found |= {perception: takes.rollout(ats, perception, seed) for perception in missing}
        npz.save(path, compress=False, **found)
        log(f"seed {seed}: rollouts finished")
    return found


def over_seeds(values: Sequence[float]) -> str:
    """Format a mean over seeds and its range."""
    return f"{np.mean(values):.3f} ({min(values):.3f} to {max(values):.3f})"


def main() -> None:
    """Simulate, train, evaluate and print the tables."""
    parser = command_lines.described(__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument(
        "--life-seeds",
        type=int,
        nargs="+",
        default=[0, 1, 2, 3, 4],
        help="seeds of the models that are rolled out",
    )
    parser.add_argument("--homes", type=int, default=24, help="training homes")
    parser.add_argument("--test-homes", type=int, default=3)
    parser.add_argument("--test-sessions", type=int, default=4, help="sessions per test home")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    arguments.out.mkdir(parents=True, exist_ok=True)
    data, scenes = load_data(arguments.out, arguments.homes, arguments.test_homes, arguments.test_sessions)
    windows, takes = data.indices(TEST)[::GOAL_STRIDE], RecordedTakes.load(data)
    context, future = data.windows(windows)
    episode = episodes(data.start[windows], data.video[windows], PAST + FUTURE)
    prior = LocationPrior.fit(*data.windows(data.indices(TRAIN)))
    prior_samples = prior.sample(context, GOALS, np.random.default_rng(0))
    print(
        f"{len(windows)} windows in {episode.max() + 1} episodes; {len(takes.path)} rollouts of {ROLLOUT_FRAMES / RATE_HZ:g} s"
    )
    print(
        f"location prior: {goal_minde(prior_samples, future).mean():.3f}, {goal_energy_score(prior_samples, future).mean():.3f}"
    )
    runs = [sampled_goals(arguments.out, seed, scenes, context) for seed in range(arguments.seeds)]
    print("| the cat is perceived | minDE, m | energy score, m | difference of energy score, m |")
    of = {perception: [Samples(run[perception]) for run in runs] for perception in PERCEIVED}
    energy = {
        perception: [goal_energy_score(each, future) for each in of[perception]] for perception in PERCEIVED
    }
    for perception in PERCEIVED:
        means = (
            over_seeds([goal_minde(each, future).mean() for each in of[perception]]),
            over_seeds(np.mean(energy[perception], 1)),
        )
        difference = np.mean(energy[perception], 0) - np.mean(energy[PERCEIVED[0]], 0)
        interval = bootstrapped(difference, episode, np.random.default_rng(0))
        print(
            f"| {perception} | {' | '.join(means)} | {interval.mean:.3f} [{interval.low:.3f}, {interval.high:.3f}] |"
        )
    runs = [rollouts(arguments.out, seed, scenes, takes) for seed in arguments.life_seeds]
    print(
        "| beside the recorded cat | recorded dog | "
        + " | ".join(f"perceived {perception}" for perception in PERCEIVED)
        + " |"
    )
    found = {perception: [takes.statistics(run[perception]) for run in runs] for perception in PERCEIVED}
    for name, value in takes.statistics(takes.path).items():
        columns = [over_seeds([each[name].mean() for each in found[perception]]) for perception in PERCEIVED]
        print(f"| {name} | {value.mean():.3f} | {' | '.join(columns)} |")


if __name__ == "__main__":
    main()
