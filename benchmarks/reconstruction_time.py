"""How long until the held-out phone's depth is right: ours, the paper's plain network, and samples spread
evenly?

    python -m benchmarks.reconstruction_time toy

The scene alone is learned, from a finished build's recordings and registration, with the settings of the
variants `mlp_fields` and `even_sampling`. Time is CPU time of one thread, and begins when the recordings are
read: fusing depth counts, drawing does not. DepthAcc@0.1m is asked over all pixels of the held-out phone; the
animal is not drawn.
"""

import argparse
import json
import time
import tomllib
from pathlib import Path

import numpy as np
import torch

from pipeline.core import config as configuration
from pipeline.core.videos import read
from pipeline.fields import marching_cubes
from pipeline.fields.fields import Field
from pipeline.geometry import cameras
from pipeline.geometry.meshes import RayCaster
from stages.evaluate import heldout, reading, reconstruction
from stages.evaluate.heldout import HeldoutShot, HeldoutView
from stages.reconstruct import assemble, fuse, optimise
from stages.reconstruct.config import Config
from stages.reconstruct.reading import Inputs, read_template, read_videos
from stages.reconstruct.scene import SceneLoss

KINDS = ("frames", "masks", "flow", "features")
VARIANTS = {"ours": None, "plain network": "mlp_fields", "even samples": "even_sampling"}
MARKS_S = (5, 10, 20, 40, 80)
ENOUGH = 0.85


def shots_of(build: Path, count: int) -> tuple[str, list[HeldoutShot]]:
    """Return what the first held-out phone saw, and the session that it filmed too."""
    videos = read(build / "plan" / "videos.json")
    frames = {video.id: build / "frames" / video.id for video in videos}
    templates = {name: build / name for name in ("scene_template", "agent_template", "reconstruction")}
    places = reading.Reconstructed(frames=frames, **templates, truth=build / "synthetic_capture" / "truth")
    known = {each.video.role: each for each in reversed(reading.recorded(places, videos))}
    truth = reading.frames_of_truth(places, known["walkthrough"], known["turnaround"])
    phone = known["heldout"]
    return phone.video.synchronized_with, reconstruction.shots_of(places, phone, truth, count)


def settings_of(build: Path, variant: str | None) -> Config:
    """Return the recipe's settings, with a variant's changes."""
    table = json.loads((build / "plan" / "configs" / "reconstruction.json").read_text())
    changes = (
        tomllib.loads(Path("agents", "variants", f"{variant}.toml").read_text())["reconstruct"]
        if variant
        else {}
    )
    for name, value in changes.items():
        table[name] = table.get(name, {}) | value if isinstance(value, dict) else value
    return configuration.from_table(Config, table, where=str(variant))


def depth_acc(field: Field, code: int, shots: list[HeldoutShot]) -> float:
    """Return the share of right depth where the held-out phone looks at the scene's surface."""
    mesh, right = marching_cubes.extract_scene(field, code, field.lattice_m), []
    caster = RayCaster(mesh) if len(mesh.faces) else None
    for shot in shots:
        rays = (
            cameras.ray_directions(shot.intrinsics, *shot.depth.shape).reshape(-1, 3)
            @ shot.world_from_camera[:3, :3].T
        )
        depth = (
            caster.cast(shot.world_from_camera[:3, 3], rays).distance
            if caster
            else np.full(len(rays), np.inf)
        )
        view = HeldoutView(shot.color, np.where(np.isfinite(depth), depth, 0).reshape(shot.depth.shape), shot)
        right.append(heldout.depth_is_right(view)[(shot.depth > 0) & (shot.depth <= heldout.RANGE_M)])
    return float(np.concatenate(right).mean())


def measure(
    build: Path, name: str, read_anew, session: str, shots: list[HeldoutShot]
) -> list[tuple[float, int, float]]:
    """Return (seconds, steps, DepthAcc) at the marks, until it is enough."""
    config, (videos, template) = settings_of(build, VARIANTS[name]), read_anew
    begin, drawing_s, step, found = time.process_time(), 0.0, 0, []
    fused, rendered = None, config.supervision == "rendered"
    if config.scene_geometry == "fused":
        fused = fuse.fuse_depth(videos, config.fusion)
    problem = assemble.build(videos, template, config.fields, config.seed, "cpu", fused, rendered=rendered)
    optimizer = torch.optim.AdamW(optimise.field_groups(problem.scene, config.rates), lr=1.0)
    loss = SceneLoss(problem, config.weights, config.batches, config.steps.scene, rendered)
    for mark in (0, *MARKS_S):
        while time.process_time() - begin - drawing_s < mark:
            optimizer.zero_grad(set_to_none=True)
            sum(loss(min(step, config.steps.scene), torch.Generator().manual_seed(step)).values()).backward()
            optimizer.step()
            step += 1
        taken, drawing = time.process_time() - begin - drawing_s, time.process_time()
        found.append(
            (taken, step, depth_acc(problem.scene, assemble.scene_ids(videos).index(session), shots))
        )
        drawing_s += time.process_time() - drawing
        print(f"{name:14} {taken:6.1f} s  {step:5} steps  DepthAcc {found[-1][2]:.3f}", flush=True)
        if found[-1][2] >= ENOUGH:
            break
    return found


def main() -> None:
    """Measure all and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("agent")
    parser.add_argument("--heldout-frames", type=int, default=8)
    given = parser.parse_args()
    torch.set_num_threads(1)
    build = Path("build", given.agent)
    session, shots = shots_of(build, given.heldout_frames)
    of_role = {video.role: video.id for video in read(build / "plan" / "videos.json")}
    found = {
        kind: {
            path.name: path for path in sorted((build / kind).iterdir()) if path.name != of_role["heldout"]
        }
        for kind in KINDS
    }
    folders = Inputs(
        **found, **{name: build / name for name in ("registration", "scene_template", "agent_template")}
    )
    begin, config = time.process_time(), settings_of(build, None)
    videos = read_videos(folders, of_role["walkthrough"], of_role["turnaround"], config.sampling, config.seed)
    read_anew = videos, read_template(folders.agent_template)
    print(f"reading takes {time.process_time() - begin:.1f} s more, for each of them")
    rows = {name: measure(build, name, read_anew, session, shots) for name in VARIANTS}
    for name, marks in rows.items():
        enough = [taken for taken, _, acc in marks if acc >= ENOUGH]
        print(
            f"{name:14} DepthAcc {ENOUGH}: {f'{enough[0]:.1f} s' if enough else f'not within {marks[-1][0]:.0f} s'}"
        )


if __name__ == "__main__":
    main()
