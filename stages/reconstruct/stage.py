"""The stage: registered recordings and templates -> fields, motion, surfaces, feature volume."""

from pathlib import Path

from pipeline.core import devices, distributed, progress
from pipeline.core.videos import Video
from pipeline.data.templates import read_floor
from pipeline.fields.fields import Reconstruction
from stages.reconstruct import assemble, former, fuse, optimize, pictures, reading, results
from stages.reconstruct.config import Config
from stages.reconstruct.reading import Inputs


def run(
    inputs: Inputs,
    config: Config,
    out: Path,
    *,
    device: devices.Device = "cpu",
    threads: int = 1,
    resume: Path | None = None,
    videos: tuple[Video, ...] = (),
) -> None:
    """Reconstruct one agent's recordings into `out`; of several processes the first writes."""
    distributed.join(device)
    workers = max(1, threads // distributed.size())
    registered = _read(inputs, config, videos, resume, workers)
    fused = None
    if config.scene_geometry == "fused":
        fused = fuse.fuse_depth(registered, config.fusion, resume, workers)
    rendered = config.supervision == "rendered"
    template = reading.read_template(inputs.agent_template)
    floor_m = read_floor(inputs.scene_template)
    problem = assemble.build(
        registered, template, config.fields, config.seed, device, fused, resume, floor_m, rendered
    )
    rays = problem.store
    progress.log(f"reconstruct: {len(problem.video)} frames, {len(rays.scene)} + {len(rays.agent)} rays")
    known, steps = None, config.steps
    if inputs.former is not None:
        known, steps = former.begin(problem, registered, inputs.former), former.shorter(steps)
        progress.log(f"reconstruct: {len(known.frame)} frames begin as in {inputs.former}")
    plan = optimize.OptimizationPlan(
        steps, config.weights, config.batches, config.rates, config.seed, resume, workers, known, rendered
    )
    records = optimize.optimize(problem, plan)
    if not distributed.leave():
        return
    ids = assemble.scene_ids(registered)
    reconstruction = Reconstruction(problem.scene, problem.agent, problem.body, ids)
    smoothing_s = 0.0 if rendered else results.SMOOTHING_S
    motions = results.motions(problem, registered, config.certain_gap_s, smoothing_s)
    sessions = {video.id: motions[video.id] for video in registered if video.camera_free}
    results.write(out, problem, reconstruction, motions, sessions)
    pictures.report_quality(out, reconstruction, sessions, inputs.frames, inputs.masks, records)


def _read(
    inputs: Inputs, config: Config, videos: tuple[Video, ...], scratch: Path | None, workers: int
) -> list[assemble.RegisteredVideo]:
    """Read the recordings that are reconstructed together."""
    by_role = {video.role: video.id for video in reversed(videos)}  # the first of each
    only = None
    if config.sessions == "filmed_twice":
        only = [video.synchronized_with for video in videos if video.role == "heldout"]
    templates = by_role["walkthrough"], by_role["turnaround"]
    return reading.read_videos(inputs, *templates, config.sampling, config.seed, only, scratch, workers)
