"""What a model gains from perceiving another animal: simulated lives of the built-in dog, which follows the cat,
plays with it and avoids it in turn.

    python -m benchmarks.social OUT --seeds 5

Lets cat, dog and a person live in furnished homes, the last ones unseen in training, trains the behaviour model
of the dog, and judges it on the same test windows with the cat as it was, with a cat that stands where it is
now, and with the cat taken out of perception. Training leaves companions out of a tenth of the samples, so none
of the three is new to the networks. What is in OUT already is not computed again.

Goals are scored as in the tables of the paper. Then the dog lives for half a minute beside the recorded cat and
person, in a closed loop: distance kept, collisions, and the shares of what it does (`doings`), which are the
same functions of simulated and true lives. Bodies are not learned; the dog looks where it goes.
"""

import argparse
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int

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
from pipeline.core.videos import Video
from pipeline.data import npz
from pipeline.geometry import rigid
from pipeline.metrics.flight import flees
from pipeline.metrics.intervals import bootstrapped, episodes
from pipeline.metrics.scores import goal_energy_score, goal_minde
from stages.read_trajectories.motion import CLIP_GAP_S, MeasuredMotion
from stages.slice_behavior import stage as slicing
from stages.slice_behavior.config import Config as SlicingConfig
from stages.synthesize_capture import camera_motion, dwellings, gait, session
from stages.synthesize_capture.dog import DOG
from stages.synthesize_capture.lives.lives import rest
from stages.synthesize_capture.observer import AT_HOME
from stages.synthesize_capture.room import Room
from stages.synthesize_capture.voxels import volume_of
from stages.train_behavior import stage as training
from stages.train_behavior.config import (
    AugmentationConfig,
    BehaviorOptimizerConfig,
    BehaviorTrainingConfig,
    ObjectiveConfig,
)
from stages.train_behavior.config import Config as TrainingConfig

TAKES, SESSION_S = 5, 150.0
"""Takes of a session, each begun anew from anywhere, and its length: as in `stages.synthesize_capture.lives`."""
WINDOW_STRIDE = 5
"""Frames between windows: neighbours are nearly the same, and a window of 6.4 s takes memory."""
MODEL = TrainingConfig(
    export=False,
    ensemble_size=1,
    training=BehaviorTrainingConfig(
        BehaviorOptimizerConfig(steps=900, goal_steps=500, goal_batch=128, rate=4e-3),
        AugmentationConfig(past=0.05, approached=0.25, approached_paths=0.5),
        ObjectiveConfig(weighting="flow", code_dropout=0.0, path_share=1.0, body_share=0.0),
    ),
)
"""As in `agents/benchmark.toml`, without bodies and with fewer steps of paths: nothing was chosen here."""
PERCEIVED = ("as it is", "standing still", "not at all")
LIVED = ("as it is", "not at all")
GOALS, GOAL_STRIDE = 16, 20
"""Samples per window, and of how many test windows one is judged."""
LIFE, LIFE_STRIDE = 280, 3
"""Frames of a life in a closed loop: two seconds less than a take; and of how many takes one is lived again."""
DOING_STRIDE = 10
"""Frames between the moments of a life at which it is asked what the dog does."""
NEAR_M, CHASE_M = 1.2, 1.1
"""Who is within so much of the cat after 5.6 s stays with it: the dog follows at 0.95 m and plays at 0.75 m. Who
covers more than that in some second plays: it follows at 0.9 m/s, plays at 1.5 m/s."""
COLLISION_M = 0.45
"""Centres nearer than this are in each other: the bodies of the built-in world keep 0.62 m on the floor."""
TURN_WAY_M = 0.3
"""Way after which a heading counts for a third, about a body's length."""
DOINGS = ("follows", "plays", "avoids", "goes its own way")


@dataclass(frozen=True)
class LooksAhead(Sampler):
    """Draws goals and paths; the body looks where it goes, upright."""

    def bodies(
        self,
        codes: PlanCondition,
        path: Float[np.ndarray, "plan frame 3"],
        sampling: PlanSamplingConfig,
        rng: np.random.Generator,
    ) -> Float[np.ndarray, "plan frame channel"]:
        """Return roots that turn along the path, from +z at the beginning."""
        steps = np.diff(path, axis=1, prepend=codes.start[:, None])[..., ::2]
        facing, found = (
            np.tile([0.0, 1.0], (len(path), 1)),
            np.zeros((*path.shape[:2], len(self.scaling.body_mean))),
        )
        for frame in range(path.shape[1]):
            step = steps[:, frame]
            facing = (
                facing * np.exp(-np.linalg.norm(step, axis=1, keepdims=True) / TURN_WAY_M) + step / TURN_WAY_M
            )
            facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-9)
            turn = np.pad(np.arctan2(*facing.T)[:, None], ((0, 0), (1, 1)))
            found[:, frame, :ROOT_CHANNELS] = rigid.rotation_to_6d(rigid.rotation_from_vector(turn))
        return found


@dataclass(frozen=True)
class Lives:
    """Takes in which the dog was recorded beside cat and person, as one lives them again."""

    context: Context
    path: Float[np.ndarray, "life frame 3"]
    """Where the dog truly went."""
    cat: Float[np.ndarray, "life frame 4"]
    """Place and kind; the past comes first."""
    person: Float[np.ndarray, "life frame 3"]

    @classmethod
    def of(cls, data: BehaviorData) -> "Lives":
        """Take the beginnings of all takes of the test."""
        data = data.with_horizon(LIFE)
        test = data.indices(TEST)
        begins = np.diff(data.start[test], prepend=-2) != 1
        some = test[begins][::LIFE_STRIDE]
        frames = data.start[some][:, None] + np.arange(data.past + LIFE)
        tracks = [data.trajectories[data.videos[video]] for video in data.video[some]]
        cats = [track.companions for track in tracks if track.companions is not None]
        cat = np.stack([each[row, 0] for each, row in zip(cats, frames, strict=True)])
        person = [track.world_from_camera[row, :3, 3] for track, row in zip(tracks, frames, strict=True)]
        context, future = data.windows(some)
        return cls(context, future.path_world, cat, np.stack(person))

    def lived_again(self, ats: Ats, *, aware: bool, seed: int) -> Float[np.ndarray, "life frame 3"]:
        """Let the dog live beside recorded cat and person, and return where it goes; it is asked to keep clear
        of the cat only where it is ``aware`` of it.
        """
        scenes, own = ats.scenes, ats.sampler
        sampler = LooksAhead(own.networks, own.schedule, own.scaling)
        dogs = AnimalBatch(
            sampler,
            scenes,
            ats.agent_from_bone_rest,
            ats.ego,
            sampling=ats.sampling,
            chaining=ReplanningConfig(),
        )
        dogs.clearance_m = clearance_of(DOG.size * rest())
        cat = self.cat[:, None]
        context = replace(self.context, companions=cat[:, :, :PAST] if aware else None)
        dogs.begin(context, np.random.default_rng(seed), companions=context.companions)
        found = []
        for frame in range(LIFE):
            past = slice(frame, frame + PAST)
            now = dogs.step(self.person[:, frame + PAST - 1], cat[:, :, past] if aware else None)
            found.append(now.root[:, 0, :3, 3])
        return np.stack(found, axis=1)

    def described(self, path: Float[np.ndarray, "life frame 3"]) -> dict[str, Float[np.ndarray, "life"]]:
        """Return per life the mean distance to the cat, the share of time in its body and of each doing."""
        cat = self.cat[:, PAST:, :3]
        apart = path - cat
        starts = np.arange(0, LIFE - FUTURE, DOING_STRIDE)
        ahead = starts[:, None] + 1 + np.arange(FUTURE)
        done = doings(path[:, ahead], path[:, starts], cat[:, ahead], cat[:, starts])
        return {
            "distance, m": np.linalg.norm(apart[..., [0, 2]], axis=-1).mean(1),
            "in its body": (np.linalg.norm(apart, axis=-1) < COLLISION_M).mean(1),
        } | {name: (done == number).mean(1) for number, name in enumerate(DOINGS)}


def lived(home: Room, rng: np.random.Generator) -> MeasuredMotion:
    """Let cat, dog and person live in a home, in several takes; the dog is the agent."""
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


def prepared(out: Path, homes: int, test_homes: int, test_sessions: int) -> tuple[BehaviorData, Scenes]:
    """Let them live, and slice what they did into windows."""
    sliced = out / "behavior_data"
    if not (sliced / "qa.json").is_file():
        videos, tables = [], {}
        for number in range(homes + test_homes):
            home = dwellings.furnish_otherwise(np.random.default_rng([0, 10, number]))
            for again in range(1 if number < homes else test_sessions):
                rng = np.random.default_rng([0, 13, number, again])
                name = f"home{number}-{again}"
                tables[name] = out / "lives" / name
                shutil.rmtree(tables[name], ignore_errors=True)
                tables[name].mkdir(parents=True)
                motion = lived(dwellings.rearranged(home, rng), rng)
                npz.save(tables[name] / "motion.npz", compress=False, **motion.arrays())
                npz.save(tables[name] / "skin.npz", agent_from_bone_rest=motion.agent_from_bone_rest)
                npz.save(tables[name] / "feature_volume.npz", **vars(motion.volume))
                split = "train" if number < homes else "test"
                videos.append(Video(name, f"{name}.npz", "session", split, None))
        log(f"{len(videos)} sessions of {SESSION_S:g} s in {homes + test_homes} homes")
        shutil.rmtree(sliced, ignore_errors=True)
        sliced.mkdir()
        slicing.run(
            slicing.Inputs(trajectories=tables),
            SlicingConfig(stride=WINDOW_STRIDE),
            sliced,
            videos=tuple(videos),
        )
    data = BehaviorData.load(sliced)
    return data, Scenes.load(sliced, data.videos)


def trained(out: Path, seed: int) -> Path:
    """Train one model, unless that was done."""
    model = out / f"behavior-{seed}"
    if not (model / "behavior.json").is_file():
        shutil.rmtree(model, ignore_errors=True)
        model.mkdir()
        training.run(training.Inputs(out / "behavior_data"), replace(MODEL, seed=seed), model)
    return model


def perceiving(context: Context, how: str) -> Context:
    """Return windows in which the cat is perceived in one of the ways of `PERCEIVED`."""
    cat = context.companions
    assert cat is not None
    match how:
        case "as it is":
            return context
        case "standing still":
            return replace(context, companions=np.repeat(cat[:, :, -1:], cat.shape[2], axis=2))
        case _:
            return replace(context, companions=np.where(np.arange(4) < 3, ABSENT_M, cat))


def doings(
    path: Float[np.ndarray, "*moment frame 3"],
    now: Float[np.ndarray, "*moment 3"],
    cat: Float[np.ndarray, "*moment frame 3"],
    cat_now: Float[np.ndarray, "*moment 3"],
) -> Int[np.ndarray, "*moment"]:
    """Return which of `DOINGS` each path of 5.6 s is, given where the cat goes meanwhile."""
    stays = np.linalg.norm((path - cat)[..., -1, :][..., [0, 2]], axis=-1) < NEAR_M
    second = (path[..., RATE_HZ:, :] - path[..., :-RATE_HZ, :])[..., [0, 2]]
    covered = np.linalg.norm(second, axis=-1).max(-1)
    return np.select([stays & (covered < CHASE_M), stays, flees(path, now, cat_now)], [0, 1, 2], 3)


def sampled_goals(out: Path, seed: int, scenes: Scenes, context: Context) -> dict[str, np.ndarray]:
    """Return a model's goals for each way of perceiving, from the same noise, unless that was done."""
    path = out / f"goals-{seed}.npz"
    if not path.is_file():
        ats = Ats.load(trained(out, seed), scenes, PlanSamplingConfig())
        shown = {how: perceiving(context, how) for how in PERCEIVED}
        goals = {how: ats.goals(seen, GOALS, np.random.default_rng(seed)).goal for how, seen in shown.items()}
        npz.save(path, compress=False, **goals)
        log(f"seed {seed}: goals are sampled")
    return npz.load(path)


def simulated_lives(out: Path, seed: int, scenes: Scenes, lives: Lives) -> dict[str, np.ndarray]:
    """Return where a model's dog goes beside the recorded cat, unless that was done."""
    path = out / f"lives-{seed}.npz"
    if not path.is_file():
        ats = Ats.load(trained(out, seed), scenes, PlanSamplingConfig())
        npz.save(
            path,
            compress=False,
            **{how: lives.lived_again(ats, aware=how == LIVED[0], seed=seed) for how in LIVED},
        )
        log(f"seed {seed}: lives are simulated")
    return npz.load(path)


def over_seeds(values: Sequence[float], form: str = ".3f") -> str:
    """Write a mean over seeds and its range."""
    return f"{np.mean(values):{form}} ({min(values):{form}} to {max(values):{form}})"


def main() -> None:
    """Simulate, train, judge, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--life-seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4], help="whose dogs live")
    parser.add_argument("--homes", type=int, default=24, help="to learn from")
    parser.add_argument("--test-homes", type=int, default=3)
    parser.add_argument("--test-sessions", type=int, default=4, help="in each of those")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    asked.out.mkdir(parents=True, exist_ok=True)
    data, scenes = prepared(asked.out, asked.homes, asked.test_homes, asked.test_sessions)
    windows, lives = data.indices(TEST)[::GOAL_STRIDE], Lives.of(data)
    context, future = data.windows(windows)
    episode = episodes(data.start[windows], data.video[windows], PAST + FUTURE)
    prior = LocationPrior.fit(*data.windows(data.indices(TRAIN)))
    blind = prior.sample(context, GOALS, np.random.default_rng(0))
    print(
        f"{len(windows)} windows in {episode.max() + 1} episodes; {len(lives.path)} lives of {LIFE / RATE_HZ:g} s"
    )
    print(
        f"location prior: {goal_minde(blind, future).mean():.3f}, {goal_energy_score(blind, future).mean():.3f}"
    )
    runs = [sampled_goals(asked.out, seed, scenes, context) for seed in range(asked.seeds)]
    print("| the cat is perceived | minDE, m | energy score, m | energy score beyond as it is, m |")
    of = {how: [Samples(run[how]) for run in runs] for how in PERCEIVED}
    energy = {how: [goal_energy_score(each, future) for each in of[how]] for how in PERCEIVED}
    for how in PERCEIVED:
        means = (
            over_seeds([goal_minde(each, future).mean() for each in of[how]]),
            over_seeds(np.mean(energy[how], 1)),
        )
        beyond = np.mean(energy[how], 0) - np.mean(energy[LIVED[0]], 0)
        held = bootstrapped(beyond, episode, np.random.default_rng(0))
        print(f"| {how} | {' | '.join(means)} | {held.mean:.3f} [{held.low:.3f}, {held.high:.3f}] |")
    runs = [simulated_lives(asked.out, seed, scenes, lives) for seed in asked.life_seeds]
    print(
        "| beside the recorded cat | the dog itself | "
        + " | ".join(f"perceived {how}" for how in LIVED)
        + " |"
    )
    found = {how: [lives.described(run[how]) for run in runs] for how in LIVED}
    for name, value in lives.described(lives.path).items():
        columns = [over_seeds([each[name].mean() for each in found[how]]) for how in LIVED]
        print(f"| {name} | {value.mean():.3f} | {' | '.join(columns)} |")


if __name__ == "__main__":
    main()
