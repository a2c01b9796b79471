"""What reconstruction costs behaviour: the same goals learned from the reconstructed and from the true trajectories.

    python -m benchmarks.behavior_truth build/cat

For a build of the built-in capture. Roots and cameras of the same windows are replaced by true ones, bones stay as they
were reconstructed. Goals are trained alone (perception and goal networks), with the defaults and the same seed, and
judged on the test video: the best of 16 goals, and the energy score.
"""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline import videos
from pipeline.files import arrays
from pipeline.models.behavior import Architecture, Sampling
from pipeline.models.diffusion import Schedule
from pipeline.models.planning import Sampler, TorchNetworks
from pipeline.models.predictors import Ats
from pipeline.models.scenes import Scenes
from pipeline.models.scores import goal_energy_score, goal_minde
from pipeline.models.trajectories import TEST, BehaviorData
from pipeline.space import rigid
from pipeline.videos import Video
from stages.evaluate.alignment import constant_between
from stages.train_behavior.training import Optimization, Settings, train

TRIALS, SAMPLES, STRIDE = 2, 16, 4
"""of the best of 16 goals, on every fourth window"""


@dataclass(frozen=True)
class Truth:
    """True poses of one recording at its extracted frames, in the truth's own frames."""

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    world_from_agent: Float[np.ndarray, "frame 4 4"] | None

    @classmethod
    def read(cls, build: Path, video: Video) -> "Truth":
        """Read what the capture's script kept for a recording."""
        table = arrays.load(build / "synthetic_capture" / "truth" / f"{Path(video.file).stem}.npz")
        frame = arrays.load(build / "frames" / video.id / "frames.npz", ("source_index",))["source_index"]
        agent = table["world_from_agent"][frame] if "world_from_agent" in table else None
        return cls(table["world_from_camera"][frame], agent)


def with_truth(data: BehaviorData, listed: tuple[Video, ...], build: Path) -> BehaviorData:
    """Return the same windows with true roots and cameras, brought into our world by the walk-through's cameras."""
    truth = {
        video.id: Truth.read(build, video) for video in listed if video.role in ("walkthrough", "turnaround") or video.id in data.videos
    }
    role = {video.role: truth[video.id] for video in listed if video.id in truth}
    world = constant_between(template_cameras(build / "scene_template", "world_from_camera"), role["walkthrough"].world_from_camera)
    around = rigid.inverse(role["turnaround"].world_from_agent) @ role["turnaround"].world_from_camera
    true_agent_from_agent = rigid.inverse(constant_between(template_cameras(build / "agent_template", "agent_from_camera"), around))
    found = {}
    for video, ours in data.trajectories.items():
        time = arrays.load(build / "reconstruction" / video / "motion.npz", ("timestamp_s",))["timestamp_s"]
        agent = world @ truth[video].world_from_agent @ true_agent_from_agent
        camera = world @ truth[video].world_from_camera
        poses = {name: rigid.interpolate(time, pose, ours.timestamp_s) for name, pose in (("agent", agent), ("camera", camera))}
        found[video] = replace(ours, world_from_agent=poses["agent"], world_from_camera=poses["camera"])
    return replace(data, trajectories=found)


def template_cameras(folder: Path, name: str) -> Float[np.ndarray, "frame 4 4"]:
    """Return the cameras of a template, NaN where a frame found no place."""
    table = arrays.load(folder / "cameras.npz")
    return np.where(table["registered"][:, None, None], table[name], np.nan)


def trained(data: BehaviorData, scenes: Scenes, steps: int, seed: int) -> Ats:
    """Train perception and goals alone and return them as a predictor of goals."""
    architecture = Architecture(bones=len(data.agent_from_bone_rest), scene_channels=scenes.channels)
    settings = Settings(Optimization(steps=steps, goal_steps=steps))
    fitted = train(data, scenes, architecture, Schedule(), settings, seed=seed)
    sampler = Sampler(TorchNetworks(fitted.nets), Schedule(), fitted.scaling)
    return Ats(sampler, scenes, data.agent_from_bone_rest, architecture.ego, Sampling())


def scores(ats: Ats, seen: BehaviorData, happened: BehaviorData) -> tuple[float, float]:
    """Return mean minDE and energy score of goals sampled from one data's past against the other's future."""
    test = seen.indices(TEST)[::STRIDE]
    context, future = seen.windows(test)[0], happened.windows(test)[1]
    rng = np.random.default_rng(0)
    trials = [ats.goals(context, SAMPLES, rng) for _ in range(TRIALS)]
    return tuple(float(np.mean([score(trial, future) for trial in trials])) for score in (goal_minde, goal_energy_score))


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("build", type=Path, help="a finished build of the built-in capture, for example build/cat")
    parser.add_argument("--steps", type=int, default=Optimization().goal_steps, help="of training")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    listed = videos.read(given.build / "plan" / "videos.json")
    data = BehaviorData.load(given.build / "behavior_data")
    scenes = Scenes.load(given.build / "behavior_data", data.videos)
    truth = with_truth(data, listed, given.build)
    ours, ideal = (trained(each, scenes, given.steps, given.seed) for each in (data, truth))
    rows = {
        "reconstructed, judged on reconstructed futures": scores(ours, data, data),
        "reconstructed, judged on true futures": scores(ours, data, truth),
        "true, judged on true futures": scores(ideal, truth, truth),
    }
    best = rows["true, judged on true futures"]
    print("| trained and asked on | goal minDE m | energy score m | minDE against true |\n|---|---|---|---|")
    for name, (minde, energy) in rows.items():
        print(f"| {name} | {minde:.3f} | {energy:.3f} | {minde / best[0]:.2f} |")


if __name__ == "__main__":
    main()
