"""The 4D reconstruction against truth: held-out views, agent roots, followed points, surfaces."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from pipeline.files import arrays, meshes
from pipeline.models import fields, gaussians
from pipeline.models.motion import Motion
from pipeline.models.render import Renderer
from pipeline.space import rigid
from pipeline.space.meshes import Mesh, RayCaster
from stages.evaluate import heldout, reading, surfaces, triangles
from stages.evaluate.alignment import pose_errors
from stages.evaluate.figures import Figures
from stages.evaluate.heldout import Shot, View
from stages.evaluate.inferred import inferred_figures
from stages.evaluate.reading import Folders, Frames, Reconstructed, Recorded
from stages.evaluate.registration import root_figures
from stages.evaluate.surfaces import Skin
from stages.evaluate.triangles import Surface
from stages.evaluate.truth import read_depth

CAMERAS_FOR_SEEN = 40
SEEN_M = 0.1
"""longest edge of the pieces of the true room, each of which is seen or not"""
SCENE_POINTS, AGENT_POINTS = 20_000, 1_000
"""on each surface, whose distance from the other is measured; of the agent's in every frame"""
SURFACE_NAMES = (
    "reconstruction/agent_root_m_median", "reconstruction/agent_root_deg_median", "reconstruction/agent_track_m_median",
    "reconstruction/agent_track_m_p90", "reconstruction/scene_chamfer_m", "reconstruction/agent_chamfer_m",
    "reconstruction/agent_chamfer_share",
)  # fmt: skip
NAMES = heldout.NAMES + SURFACE_NAMES


@dataclass(frozen=True)
class Effort:
    """How much is looked at."""

    heldout_frames: int
    surface_frames: int
    """per session, for the agent's surface"""


def reconstruction_figures(
    folders: Folders, known: Sequence[Recorded], frames: Frames, effort: Effort, rng: np.random.Generator, device: str
) -> Figures:
    """Return everything about the reconstruction."""
    figures = Figures()
    sessions = [each for each in known if each.video.role == "session"]
    motions = {each.video.id: reading.read_motion(folders.reconstruction, each.video.id) for each in sessions}
    figures.add(agent_roots(sessions, motions, frames))
    figures.add(inferred_figures(sessions, motions, frames))
    turnaround = next(each for each in known if each.video.role == "turnaround")
    figures.add(surfaces.track_figures(track_distances(folders, sessions, motions, turnaround, frames)))
    figures.add(_agent_chamfer(folders, sessions, motions, frames, effort, rng))
    walkthrough = next(each for each in known if each.video.role == "walkthrough")
    figures.add(_scene_chamfer(folders, walkthrough, frames, rng))
    figures.add(_held_out(folders, [each for each in known if each.video.role == "heldout"], frames, effort, device))
    return figures


def _held_out(folders: Folders, phones: Sequence[Recorded], frames: Frames, effort: Effort, device: str) -> Figures:
    """Compare with what the held-out phones truly saw."""
    phones = [phone for phone in phones if phone.video.synchronized_with]
    seen = [(phone.video.synchronized_with, shots_of(folders, phone, frames, effort.heldout_frames)) for phone in phones]
    return held_out_figures(folders, seen, device)


def held_out_figures(folders: Folders, seen: Sequence[tuple[str, Sequence[Shot]]], device: str) -> Figures:
    """Draw the shots of phones, each with the session it is synchronized with, by the fields and by the 3D Gaussians.

    Where that session was refused nothing is drawn, which is wrong everywhere.
    """
    figures, by_fields, by_splats, drawn = Figures(), [], [], 0
    for session, shots in seen:
        motion = reading.read_motion(folders.reconstruction, session)
        by_fields += drawn_by_fields(folders, session, motion, shots, device)
        by_splats += _drawn_by_splats(folders, session, reading.read_motion(folders.splats, session) or motion, shots)
        drawn += motion is not None and len(shots) > 0
    figures.put("reconstruction/heldout_phones_drawn", drawn)
    figures.put("reconstruction/heldout_phones_total", len(seen))
    figures.put("reconstruction/heldout_frames", len(by_fields))
    if by_fields:
        figures.add(heldout.view_figures(by_fields))
        figures.add(heldout.picture_figures("splats", by_splats))
        for name, views in (("fields", by_fields), ("splats", by_splats)):
            caption = f"held-out phone: truth, ours ({name}), true depth, our depth"
            figures.pictures[caption] = heldout.side_by_side(views)
    else:
        figures.skip(heldout.NAMES, heldout.UNSEEN)
    return figures


def agent_roots(sessions: Sequence[Recorded], motions: Mapping[str, Motion | None], frames: Frames) -> Figures:
    """Compare the agent's root with truth in the frames that truly show the agent; what is inferred there is not placed."""
    errors, placed = [], []
    for each in sessions:
        motion, visible = motions[each.video.id], each.truth.agent_visible
        ours = np.full((len(visible), 4, 4), np.nan) if motion is None else motion.world_from_agent
        errors.append(pose_errors(ours, frames.roots(each.truth))[visible])
        placed.append((np.zeros(len(visible), bool) if motion is None else motion.agent_known)[visible])
    return root_figures("reconstruction", errors, placed)


def shots_of(folders: Reconstructed, phone: Recorded, frames: Frames, count: int) -> list[Shot]:
    """Return what the held-out phone saw while its session was filmed, in up to ``count`` frames, at its depth's resolution."""
    true, cameras, shots = read_depth(folders.truth, phone.name, phone.source_index), frames.cameras(phone.truth), []
    for frame in reading.spread(reading.filmed_together(folders, phone.video), count).tolist():
        size = true.depth[frame].shape[::-1]
        color = cv2.resize(phone.clip.color(frame), size, interpolation=cv2.INTER_AREA)
        agent = cv2.resize(phone.truth.masks[frame].astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        time_s = float(phone.clip.timestamp_s[frame] + phone.video.offset_s)
        shots.append(Shot(cameras[frame], true.intrinsics[frame], time_s, color, true.depth[frame], agent))
    return shots


def drawn_by_fields(folders: Reconstructed, session: str, motion: Motion | None, shots: Sequence[Shot], device: str) -> list[View]:
    """Draw the reconstruction as the synchronized session saw it; nothing where that was refused."""
    if motion is None:
        return [View.empty(shot) for shot in shots]
    renderer, views = Renderer(fields.load(folders.reconstruction, device), session), []
    for shot in shots:
        picture = renderer.draw(shot.world_from_camera, shot.intrinsics, *shot.depth.shape, *motion.at(shot.time_s))
        views.append(View(picture.color, picture.depth, shot))
    return views


def _drawn_by_splats(folders: Folders, session: str, motion: Motion | None, shots: Sequence[Shot]) -> list[View]:
    """Draw the 3D Gaussians as they stood in a session; where the animal's pose is not known, the room alone."""
    if motion is None:
        return [View.empty(shot) for shot in shots]
    scene, agent = gaussians.load_scene(folders.splats, session), gaussians.load_ply(folders.splats / "agent.ply")
    weights = torch.from_numpy(arrays.load(folders.splats / "splats.npz", ("agent_weights",))["agent_weights"])
    rest = torch.from_numpy(arrays.load(folders.reconstruction / "skin.npz")["agent_from_bone_rest"])
    splats, views = gaussians.Splats(scene, agent, weights, rest, videos=0), []
    for shot in shots:
        cloud, (root, bones) = splats.place_scene(None), motion.at(shot.time_s)
        if root is not None:
            posed = (torch.as_tensor(part, dtype=torch.float32) for part in (root, bones))
            cloud = gaussians.together(cloud, splats.place_agent(*posed, None))
        camera = (rigid.inverse(shot.world_from_camera), shot.intrinsics)
        with torch.no_grad():
            seen = gaussians.see(cloud, *(torch.as_tensor(part, dtype=torch.float32) for part in camera), *shot.depth.shape)
        color = (seen.color.clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()
        views.append(View(color, seen.depth.numpy(), shot))
    return views


def _skin(folders: Reconstructed) -> tuple[Mesh, Skin]:
    mesh, table = (
        meshes.read_ply(folders.reconstruction / "agent.ply"),
        arrays.load(folders.reconstruction / "skin.npz"),
    )
    return mesh, Skin(mesh.vertices, table["weights"], table["agent_from_bone_rest"])


def track_distances(
    folders: Reconstructed, sessions: Sequence[Recorded], motions: dict, turnaround: Recorded, frames: Frames
) -> list[np.ndarray]:
    """Follow surface points that are matched to truth once, in the turnaround; return distances per visible frame, metres."""
    skin = _skin(folders)[1].only(arrays.load(folders.reconstruction / "tracks.npz")["vertex_index"])
    partner = surfaces.matched_once(skin.points_agent, _at_rest(turnaround, frames))
    distances = []
    for each in sessions:
        motion = motions[each.video.id]
        for frame in np.flatnonzero(each.truth.agent_visible):
            true = rigid.apply(frames.world_from_true_world, each.truth.vertices_world(frame)[partner])
            ours = _posed(skin, motion, frame)
            distances.append(np.full(len(partner), np.inf) if ours is None else np.linalg.norm(ours - true, axis=1))
    return distances


def _at_rest(turnaround: Recorded, frames: Frames, every: int = 8) -> Iterator[np.ndarray]:
    """Return the true surface of some frames of the turnaround, in our agent frame: its tail may swing meanwhile."""
    truth = turnaround.truth
    for frame in range(0, len(turnaround.clip), every):
        in_agent = rigid.apply(rigid.inverse(truth.world_from_agent[frame]), truth.vertices_world(frame))
        yield rigid.apply(frames.agent_from_true_agent, in_agent)


def _posed(skin: Skin, motion: Motion | None, frame: int) -> np.ndarray | None:
    if motion is None or not np.isfinite(motion.world_from_agent[frame]).all():
        return None
    return skin.posed(motion.world_from_agent[frame], motion.agent_from_bone[frame])


def _agent_chamfer(
    folders: Folders, sessions: Sequence[Recorded], motions: dict, frames: Frames, effort: Effort, rng: np.random.Generator
) -> Figures:
    """Compare the agent's surface where its pose is known, and tell in what share of the frames that is."""
    figures, (mesh, skin), distances, total = Figures(), _skin(folders), [], 0
    faces = meshes.read_ply(folders.truth / "agent.ply").faces
    for each in sessions:
        motion = motions[each.video.id]
        chosen = reading.spread(np.flatnonzero(each.truth.agent_visible), effort.surface_frames)
        total += len(chosen)
        for frame in chosen if motion is not None else ():
            if motion.agent_known[frame]:
                ours = Surface(_posed(skin, motion, frame)[mesh.faces])
                true = Surface(rigid.apply(frames.world_from_true_world, each.truth.vertices_world(frame))[faces])
                distances.append(surfaces.chamfer(ours, true, AGENT_POINTS, rng))
    value, share = (float(np.mean(distances)), len(distances) / total) if distances else (np.nan, 0.0 if total else np.nan)
    figures.put("reconstruction/agent_chamfer_m", value, "the agent's pose is known in no visible frame")
    figures.put("reconstruction/agent_chamfer_share", share, "the animal is never visible")
    return figures


def _scene_chamfer(folders: Folders, walkthrough: Recorded, frames: Frames, rng: np.random.Generator) -> Figures:
    """Compare the scene's surface with the true room, on what the walk-through saw of it."""
    figures = Figures()
    ours, true = meshes.read_ply(folders.reconstruction / "scene.ply"), meshes.read_ply(folders.truth / "scene.ply")
    true = Mesh(rigid.apply(frames.world_from_true_world, true.vertices.astype(float)).astype(np.float32), true.faces)
    cameras, pieces = frames.cameras(walkthrough.truth), triangles.cut(triangles.corners(true), SEEN_M)
    chosen = np.unique(np.linspace(0, len(cameras) - 1, CAMERAS_FOR_SEEN).astype(int))
    camera = (cameras[chosen], walkthrough.truth.intrinsics[chosen], walkthrough.clip.color_size)
    seen = Surface(pieces[surfaces.seen_by(RayCaster(true), pieces.mean(1), *camera)])
    figures.put("reconstruction/scene_chamfer_m", surfaces.chamfer(Surface.of(ours), seen, SCENE_POINTS, rng))
    return figures
