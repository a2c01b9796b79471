"""Files of a long-term take: motion, animated surface, frames for a video, plausibility metrics."""

import json
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.ndimage import gaussian_filter1d

from pipeline.core import progress
from pipeline.data import glb, images, npz
from pipeline.fields import weight_refit
from pipeline.fields.skinning import SkinnedShape
from pipeline.geometry import rigid, views
from pipeline.geometry.meshes import Mesh, RayCaster, render_view
from pipeline.longterm.bodies import PosedSurface, SkinnedBody
from pipeline.longterm.journeys import Journey
from pipeline.longterm.plausibility import Plausibility
from pipeline.longterm.short_motions import RATE_HZ, BodyMotion
from pipeline.metrics.intervals import finite

FRAME_SIZE, FOCAL = (360, 480), 0.9
"""Height and width of the frames, pixels, and their focal length in units of the width."""
SMOOTHED_FRAMES, TURNED_FRAMES = 12.0, 20.0
"""Standard deviations of the Gaussians that smooth the camera's target and its direction, frames."""
ASIDE_M, ABOVE_M, OFF_CENTER_M = 1.3, [0.0, 1.4, 0.05], 0.3
"""Camera offset from the animal; nearer to the room's center than the last, the horizontal offset shrinks."""
AMBIENT, DIFFUSE = 0.45, 0.55
"""Ambient and diffuse shading of the animal."""
FITTED_POSES = 60
"""Poses of a take that the four skinning weights per vertex are fitted to."""


def write_journey(folder: Path, journey: Journey, body: SkinnedBody) -> None:
    """Write `take.npz` (30 fps), `take.glb` and `take.json`."""
    npz.save(
        folder / "take.npz",
        timestamp_s=journey.timestamp_s,
        world_from_agent=journey.motion.world_from_agent,
        agent_from_bone=journey.motion.agent_from_bone.astype(np.float32),
        subgoals_world=journey.subgoals_world,
        arrival_s=journey.arrival_s.astype(np.float64),
    )
    motion = journey.motion
    skin = fit_skin(body, motion.agent_from_bone)
    action = glb.Action("take", journey.timestamp_s, motion.world_from_agent, motion.agent_from_bone)
    (folder / "take.glb").write_bytes(glb.skinned(body.mesh, skin, [action]))
    about = {
        "units": "metres, radians, seconds",
        "up": [0, 1, 0],
        "rate_hz": RATE_HZ,
        "seconds": float(journey.timestamp_s[-1]),
        "subgoals_world": journey.subgoals_world.tolist(),
        "arrival_s": journey.arrival_s.tolist(),
        "largest_seam_m": journey.largest_seam_m,
    }
    write_metrics(folder, journey.before, journey.after, **about)


def write_metrics(folder: Path, before: Plausibility, after: Plausibility, **about: object) -> None:
    """Write `take.json`: a description of the take, and its plausibility before and after optimization."""
    metrics = {
        when: {name: finite(value) for name, value in vars(each).items()}
        for when, each in (("before", before), ("after", after))
    }
    (folder / "take.json").write_text(json.dumps({**about, **metrics}, indent=1, allow_nan=False) + "\n")


def write_frames(folder: Path, motion: BodyMotion, body: SkinnedBody, scene: Mesh, *, rate_hz: float) -> None:
    """Write `frames/%06d.jpg`: renderings of animal and scene by a camera that follows from above."""
    (folder / "frames").mkdir()
    height, width = FRAME_SIZE
    caster, surface = RayCaster(scene), PosedSurface(body)
    intrinsics = np.array([[FOCAL * width, 0, width / 2], [0, FOCAL * width, height / 2], [0, 0, 1.0]])
    cameras = follow_camera(motion.world_from_agent[:, :3, 3], np.median(scene.vertices, axis=0))
    chosen = np.arange(0, len(motion), max(1, round(RATE_HZ / rate_hz)))
    for number, frame in enumerate(progress.track(chosen, "frames", total=len(chosen))):
        posed = surface(*motion[frame : frame + 1].tensors())[0].numpy()
        animal = Mesh(posed, body.mesh.faces, body.mesh.color)
        picture = render(caster, animal, cameras[frame], intrinsics, height, width)
        images.write_color(folder / "frames" / f"{number:06d}.jpg", picture)


def follow_camera(
    roots_world: Float[np.ndarray, "frame 3"], center: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "frame 4 4"]:
    """Return poses of a smoothly moving camera above the animal, on the side of the room's center."""
    target = np.asarray(gaussian_filter1d(roots_world, SMOOTHED_FRAMES, axis=0, mode="nearest"))
    away = (center - target) * [1.0, 0.0, 1.0]
    away = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), OFF_CENTER_M)
    away = gaussian_filter1d(away, TURNED_FRAMES, axis=0, mode="nearest")
    return rigid.look_at(target + ASIDE_M * away + ABOVE_M, target, np.array([0.0, 1.0, 0.0]))


def render(
    scene: RayCaster,
    animal: Mesh,
    world_from_camera: Float[np.ndarray, "4 4"],
    intrinsics: Float[np.ndarray, "3 3"],
    height: int,
    width: int,
) -> UInt8[np.ndarray, "height width 3"]:
    """Render animal and scene with a depth test; the animal is shaded by its normals."""
    scene_depth, scene_hits = render_view(scene, world_from_camera, intrinsics, height, width)
    animal_depth, hits = render_view(RayCaster(animal), world_from_camera, intrinsics, height, width)
    in_front = (animal_depth > 0) & ((scene_depth == 0) | (animal_depth < scene_depth))
    facing = np.abs(hits.interpolate(animal, animal.vertex_normals()) @ world_from_camera[:3, 2])
    shaded = views.shade(animal, hits) * (AMBIENT + DIFFUSE * facing[:, None])
    picture = views.shade(scene.mesh, scene_hits).reshape(height, width, 3)
    return np.where(in_front[..., None], shaded.reshape(height, width, 3).astype(np.uint8), picture)


def fit_skin(body: SkinnedBody, agent_from_bone: Float[np.ndarray, "frame bone 4 4"]) -> glb.Skin:
    """Fit four skinning weights per vertex to the surface in the poses that differ most."""
    rest = body.agent_from_bone_rest
    some = agent_from_bone[weight_refit.farthest_poses(agent_from_bone, FITTED_POSES)]
    roots = torch.eye(4).expand(len(some), 4, 4)
    posed = PosedSurface(body)(roots, torch.from_numpy(some).float()).double().numpy()
    poses = weight_refit.Poses(some @ rigid.inverse(rest), posed)
    shape = SkinnedShape(np.asarray(body.mesh.vertices, np.float64), body.weights, rest)
    return weight_refit.refit_weights(shape, poses)
