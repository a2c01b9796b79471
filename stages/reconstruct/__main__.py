"""Reconstruct scene, agent and motion in 4D from registered recordings.

Fits two neural fields (the scene with a code per video, the agent with 25 Gaussian bones), the phone's and the
agent's poses to colour, depth, masks, flow and features of all registered sessions, the walk-through and the
turnaround; then extracts surfaces, skin, motion per video and the scene's feature volume.
"""

from dataclasses import dataclass
from typing import Literal

from pipeline import cli, dag, progress, together
from pipeline.models.fields import Reconstruction
from stages.reconstruct import assemble, fuse, hidden, optimise, pictures, reading, results, writing
from stages.reconstruct.assemble import Shapes
from stages.reconstruct.fuse import Fusion
from stages.reconstruct.rays import Sampling
from stages.reconstruct.settings import Batches, Rates, Steps, Weights


@dataclass(frozen=True)
class Config:
    """Settings of the reconstruction."""

    seed: int = 0
    """of all randomness"""
    sampling: Sampling = Sampling(scene_per_frame=256, agent_per_frame=160)
    """pixels kept of each frame"""
    shapes: Shapes = Shapes()
    """sizes of the fields"""
    steps: Steps = Steps()
    """length of each phase"""
    batches: Batches = Batches()
    """what a step looks at"""
    weights: Weights = Weights()
    """of the losses"""
    rates: Rates = Rates()
    """of learning"""
    sessions: Literal["all", "filmed_twice"] = "all"
    """what is reconstructed together: all registered sessions and the walk-through, or one session alone (single-video
    baselines): the first that a held-out phone filmed too, else the first"""
    ground: Literal["fused", "none"] = "fused"
    """what the scene's field learns on: fused depth, or nothing (baselines)"""
    fusion: Fusion = Fusion()
    """how depth is fused"""
    agent_step_m: float = 0.01
    """resolution of the extracted agent, metres"""
    gaps: results.Gaps = results.Gaps()
    """how moments without a view of the agent are crossed"""


def run(task: cli.Task) -> None:
    """Reconstruct one agent's recordings."""
    together.join(task.device)
    config, scratch, workers = task.config, task.resume, max(1, task.threads // together.size())
    per_video = {name: task.per_video(name, dag.VIEWED if name == "frames" else None) for name in ("frames", "masks", "flow", "features")}
    single = {name: task.input(name) for name in ("registration", "scene_template", "agent_template")}
    folders = reading.Folders(**per_video, **single, scratch=scratch)
    by_role = {video.role: video.id for video in task.videos}
    twice = [video.synchronized_with for video in task.videos if video.role == "heldout"] if config.sessions == "filmed_twice" else None
    videos = reading.read_videos(folders, by_role["walkthrough"], by_role["turnaround"], config.sampling, config.seed, twice, workers)
    fused = fuse.ground(videos, config.shapes.scene_margin_m, config.fusion, scratch, workers) if config.ground == "fused" else None
    template, floor_m = reading.read_template(folders.agent_template), reading.read_floor(folders.scene_template)
    problem = assemble.build(videos, template, config.shapes, config.seed, task.device, fused, scratch, floor_m)
    progress.log(f"reconstruct: {len(problem.video)} frames, {len(problem.store.scene)} scene rays, {len(problem.store.agent)} agent rays")
    plan = optimise.Plan(config.steps, config.weights, config.batches, config.rates, config.seed, scratch, workers)
    records = optimise.optimise(problem, plan)
    if not together.leave():
        return
    reconstruction = Reconstruction(problem.scene, problem.agent, problem.body, assemble.scene_ids(videos))
    motions = hidden.inferred(problem, videos, results.motions(problem, videos, config.gaps.longest_s), config.gaps.certain_s)
    sessions = [video.id for video in videos if video.camera_free]
    scene, agent = results.scene_surface(problem), results.agent_surface(problem, config.agent_step_m)
    with task.create() as folder:
        writing.write(folder, problem, reconstruction, motions, sessions, scene, agent)
        pictures.report_quality(folder, reconstruction, {id: motions[id] for id in sessions}, per_video, records)


if __name__ == "__main__":
    reads = ("frames", "masks", "flow", "features", "registration", "scene_template", "agent_template")
    cli.enter(__doc__, run, config=Config, reads=reads)
