"""The 4D reconstruction against truth: held-out views, agent roots, followed points, surfaces."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float

from pipeline.core import devices
from pipeline.data import gaussian_ply, ply
from pipeline.data.motion import TRACKS, Motion
from pipeline.data.templates import SkinTable, bones_at_rest
from pipeline.fields import fields, gaussians
from pipeline.fields.render import Renderer, render_depth
from pipeline.fields.skinning import SkinnedShape
from pipeline.geometry import rigid, subsampling
from pipeline.geometry.meshes import Mesh, RayCaster
from pipeline.metrics.lpips import Lpips
from pipeline.metrics.metrics import Metrics, mean
from pipeline.metrics.pose_errors import pose_errors
from pipeline.metrics.surface_distance import TriangleSurface, chamfer, split
from stages.evaluate import heldout, reading, surfaces
from stages.evaluate.config import Config
from stages.evaluate.heldout import HeldoutShot, HeldoutView
from stages.evaluate.reading import BuildFolders, Reconstructed, RecordingWithTruth, TruthAlignment
from stages.evaluate.registration import root_metrics
from stages.evaluate.truth import read_depth

CAMERAS_FOR_SEEN = 40
SEEN_M = 0.1
"""longest edge of the pieces of the true room, each of which is seen or not"""
FARTHEST_M = 1.2 * heldout.RANGE_M
"""z at which rendered rays end: a wall at the end of the measured range is behind nothing"""
SCENE_POINTS, AGENT_POINTS = 20_000, 1_000
"""on each surface, whose distance from the other is measured; of the agent's in every frame"""
NAMES = heldout.NAMES + tuple(
    f"reconstruction/{name}"
    for name in (
        "agent_root_m_median", "agent_root_deg_median", "agent_track_m_median", "agent_track_m_p90",
        "scene_chamfer_m", "agent_chamfer_m", "agent_chamfer_share",
    )
)  # fmt: skip


def reconstruction_metrics(
    folders: BuildFolders,
    known: Sequence[RecordingWithTruth],
    frames: TruthAlignment,
    config: Config,
    rng: np.random.Generator,
    device: devices.Device,
) -> Metrics:
    """Return everything about the reconstruction."""
    metrics = Metrics()
    sessions = reading.of_role(known, "session")
    motions = {each.video.id: reading.read_motion(folders.reconstruction, each.video.id) for each in sessions}
    metrics.add(agent_roots(sessions, motions, frames))
    turnaround, walkthrough = (reading.of_role(known, role)[0] for role in ("turnaround", "walkthrough"))
    metrics.add(surfaces.track_metrics(track_distances(folders, sessions, motions, turnaround, frames)))
    metrics.add(_agent_chamfer(folders, sessions, motions, frames, config, rng))
    metrics.add(_scene_chamfer(folders, walkthrough, frames, rng))
    seen = [
        (session.video.id, shots_of(folders, phone, session, frames, config.heldout_frames))
        for phone, session in phones_with_sessions(known)
    ]
    metrics.add(held_out_metrics(folders, seen, device, config.lpips_weights))
    return metrics


def held_out_metrics(
    folders: BuildFolders,
    seen: Sequence[tuple[str, Sequence[HeldoutShot]]],
    device: devices.Device,
    lpips_weights: str = "",
) -> Metrics:
    """Draw the shots of phones, each with the session it is synchronized with, by the fields and by the 3D
    Gaussians.

    Where that session was refused nothing is drawn, which is wrong everywhere.
    """
    metrics, by_fields, by_splats, rendered, drawn = Metrics(), [], [], [], 0
    few = iter(heldout.thinned([shot for _, shots in seen for shot in shots], heldout.RENDERED_PIXELS))
    for session, shots in seen:
        motion = reading.read_motion(folders.reconstruction, session)
        integrated = list(islice(few, len(shots)))
        surfaces, depths = drawn_by_fields(folders, session, motion, shots, integrated, device)
        by_fields, rendered = by_fields + surfaces, rendered + depths
        refined = reading.read_motion(folders.splats, session) or motion
        by_splats += _drawn_by_splats(folders, session, refined, shots)
        drawn += motion is not None and len(shots) > 0
    metrics.put("reconstruction/heldout_phones_drawn", drawn)
    metrics.put("reconstruction/heldout_phones_total", len(seen))
    metrics.put("reconstruction/heldout_frames", len(by_fields))
    if by_fields:
        lpips = Lpips.load(Path(lpips_weights), device) if lpips_weights else None
        metrics.add(heldout.view_metrics(by_fields, lpips))
        metrics.add(heldout.depth_metrics("reconstruction/rendered_depth_acc", rendered))
        metrics.add(heldout.picture_metrics("splats", by_splats))
        for name, views in (("fields", by_fields), ("splats", by_splats)):
            caption = f"held-out phone: truth, ours ({name}), true depth, our depth"
            metrics.pictures[caption] = heldout.side_by_side(views)
    else:
        metrics.skip(heldout.NAMES, heldout.UNSEEN)
    return metrics


def agent_roots(
    sessions: Sequence[RecordingWithTruth], motions: Mapping[str, Motion | None], frames: TruthAlignment
) -> Metrics:
    """Compare the agent's root with truth where it is visible; interpolated poses do not count as placed."""
    errors, placed = [], []
    for each in sessions:
        motion, visible = motions[each.video.id], each.truth.agent_visible
        ours = np.full((len(visible), 4, 4), np.nan) if motion is None else motion.world_from_agent
        errors.append(pose_errors(ours, frames.roots(each.truth))[visible])
        placed.append((np.zeros(len(visible), bool) if motion is None else motion.agent_known)[visible])
    return root_metrics("reconstruction", errors, placed)


def phones_with_sessions(
    known: Sequence[RecordingWithTruth],
) -> list[tuple[RecordingWithTruth, RecordingWithTruth]]:
    """Return the held-out phones, each with the session that it is synchronized with."""
    of_id = {each.video.id: each for each in known}
    return [
        (each, of_id[each.video.synchronized_with])
        for each in known
        if each.video.role == "heldout" and each.video.synchronized_with in of_id
    ]


def shots_of(
    folders: Reconstructed,
    phone: RecordingWithTruth,
    session: RecordingWithTruth,
    frames: TruthAlignment,
    count: int,
) -> list[HeldoutShot]:
    """Return what the held-out phone saw during ``session``, in up to ``count`` frames, depth-sized."""
    depth, intrinsics = read_depth(folders.truth_folder, phone.name, phone.source_index)
    cameras = frames.cameras(phone.truth)
    shots = []
    for frame in subsampling.some(reading.filmed_together(folders, phone.video), count).tolist():
        size = depth[frame].shape[::-1]
        color = cv2.resize(phone.clip.color(frame), size, interpolation=cv2.INTER_AREA)
        mask = phone.truth.masks[frame].astype(np.uint8)
        agent = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST) > 0
        time_s = float(phone.clip.timestamp_s[frame] + phone.video.offset_s)
        meanwhile = int(np.abs(session.clip.timestamp_s - time_s).argmin())
        share = float(session.truth.masks[meanwhile].mean())
        seen = color, depth[frame], agent, share
        shots.append(HeldoutShot(cameras[frame], intrinsics[frame], time_s, *seen))
    return shots


def drawn_by_fields(
    folders: Reconstructed,
    session: str,
    motion: Motion | None,
    shots: Sequence[HeldoutShot],
    integrated: Sequence[HeldoutShot],
    device: devices.Device,
) -> tuple[list[HeldoutView], list[HeldoutView]]:
    """Draw the reconstruction as the synchronized session saw it: ``shots`` on its surfaces, ``integrated``
    by integrating the fields along rays, as the paper measures depth (without color). Nothing where the
    session was refused.
    """
    if motion is None:
        return [HeldoutView.empty(shot) for shot in shots], [HeldoutView.empty(shot) for shot in integrated]
    reconstruction = fields.load(folders.reconstruction, device)
    renderer, surfaces, depths = Renderer(reconstruction, session), [], []
    for shot in shots:
        picture = renderer.draw(*_camera(shot), *motion.at(shot.time_s))
        surfaces.append(HeldoutView(picture.color, picture.depth, shot))
    for shot in integrated:
        depth, _ = render_depth(reconstruction, *_camera(shot), FARTHEST_M, session, *motion.at(shot.time_s))
        depths.append(HeldoutView(np.zeros_like(shot.color), depth, shot))
    return surfaces, depths


def _camera(shot: HeldoutShot) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "3 3"], int, int]:
    return shot.world_from_camera, shot.intrinsics, *shot.depth.shape


def _drawn_by_splats(
    folders: BuildFolders, session: str, motion: Motion | None, shots: Sequence[HeldoutShot]
) -> list[HeldoutView]:
    """Draw the 3D Gaussians as they stood in a session; the room alone where the pose is not known."""
    if motion is None:
        return [HeldoutView.empty(shot) for shot in shots]
    scene = gaussians.load_scene(folders.splats, session)
    agent = gaussians.load_ply(folders.splats / "agent.ply")
    table = gaussian_ply.SPLATS.load(folders.splats / "splats.npz", "agent_weights")
    weights = torch.from_numpy(table["agent_weights"])
    rest = torch.from_numpy(bones_at_rest(folders.reconstruction))
    splats, views = gaussians.Splats(scene, agent, weights, rest, videos=0), []
    for shot in shots:
        cloud, (root, bones) = splats.place_scene(None), motion.at(shot.time_s)
        if root is not None:
            posed = [torch.as_tensor(part, dtype=torch.float32) for part in (root, bones)]
            cloud = gaussians.concatenate(cloud, splats.place_agent(*posed, video=None))
        camera_from_world = torch.as_tensor(rigid.inverse(shot.world_from_camera), dtype=torch.float32)
        intrinsics = torch.as_tensor(shot.intrinsics, dtype=torch.float32)
        height, width = shot.depth.shape
        with torch.no_grad():
            seen = gaussians.render(cloud, camera_from_world, intrinsics, height, width)
        color = (seen.color.clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()
        views.append(HeldoutView(color, seen.depth.numpy(), shot))
    return views


def _skin(folders: Reconstructed) -> tuple[Mesh, SkinnedShape]:
    mesh, table = (ply.read_ply(folders.reconstruction / "agent.ply"), SkinTable.open(folders.reconstruction))
    return mesh, SkinnedShape(mesh.vertices, table.weights, table.agent_from_bone_rest)


def track_distances(
    folders: Reconstructed,
    sessions: Sequence[RecordingWithTruth],
    motions: Mapping[str, Motion | None],
    turnaround: RecordingWithTruth,
    frames: TruthAlignment,
) -> list[Float[np.ndarray, "point"]]:
    """Return distances, meters per visible frame, of surface points matched to truth in the turnaround."""
    skin = _skin(folders)[1].only(TRACKS.load(folders.reconstruction / "tracks.npz")["vertex_index"])
    partner = surfaces.matched_once(skin.vertices, _at_rest(turnaround, frames))
    distances = []
    for each in sessions:
        motion = motions[each.video.id]
        for frame in np.flatnonzero(each.truth.agent_visible).tolist():
            true = rigid.apply(frames.world_from_true_world, each.truth.vertices_world(frame)[partner])
            ours = _posed(skin, motion, frame)
            lost = np.full(len(partner), np.inf)
            distances.append(lost if ours is None else np.linalg.norm(ours - true, axis=1))
    return distances


def _at_rest(turnaround: RecordingWithTruth, frames: TruthAlignment) -> Iterator[np.ndarray]:
    """Yield the true surface of some frames of the turnaround, in our agent frame."""
    truth = turnaround.truth
    for frame in range(0, len(turnaround.clip), 8):
        in_agent = rigid.apply(rigid.inverse(truth.world_from_agent[frame]), truth.vertices_world(frame))
        yield rigid.apply(frames.agent_from_true_agent, in_agent)


def _posed(skin: SkinnedShape, motion: Motion | None, frame: int) -> np.ndarray | None:
    if motion is None or not np.isfinite(motion.world_from_agent[frame]).all():
        return None
    return rigid.apply(motion.world_from_agent[frame], skin.posed(motion.agent_from_bone[frame]))


def _agent_chamfer(
    folders: BuildFolders,
    sessions: Sequence[RecordingWithTruth],
    motions: Mapping[str, Motion | None],
    frames: TruthAlignment,
    config: Config,
    rng: np.random.Generator,
) -> Metrics:
    """Compare the agent's surface where its pose is known, and measure in what share of frames it is."""
    metrics, (mesh, skin), distances, total = Metrics(), _skin(folders), [], 0
    faces = ply.read_ply(folders.truth_folder / "agent.ply").faces
    for each in sessions:
        motion = motions[each.video.id]
        chosen = subsampling.some(np.flatnonzero(each.truth.agent_visible), config.surface_frames)
        total += len(chosen)
        for frame in chosen.tolist():
            known = motion is not None and motion.agent_known[frame]
            posed = _posed(skin, motion, frame) if known else None
            if posed is not None:
                true = rigid.apply(frames.world_from_true_world, each.truth.vertices_world(frame))
                surfaces_world = TriangleSurface(posed[mesh.faces]), TriangleSurface(true[faces])
                distances.append(chamfer(*surfaces_world, AGENT_POINTS, rng))
    value = mean(np.array(distances))
    share = len(distances) / total if total else np.nan
    metrics.put("reconstruction/agent_chamfer_m", value, "the agent's pose is known in no visible frame")
    metrics.put("reconstruction/agent_chamfer_share", share, "the animal is never visible")
    return metrics


def _scene_chamfer(
    folders: BuildFolders, walkthrough: RecordingWithTruth, frames: TruthAlignment, rng: np.random.Generator
) -> Metrics:
    """Compare the scene's surface with the true room, on what the walk-through saw of it."""
    metrics = Metrics()
    ours = ply.read_ply(folders.reconstruction / "scene.ply")
    true = ply.read_ply(folders.truth_folder / "scene.ply")
    true = Mesh(
        rigid.apply(frames.world_from_true_world, true.vertices.astype(float)).astype(np.float32), true.faces
    )
    cameras = frames.cameras(walkthrough.truth)
    pieces = split(true.vertices[true.faces].astype(np.float64), SEEN_M)
    chosen = subsampling.evenly(len(cameras), CAMERAS_FOR_SEEN)
    camera = (cameras[chosen], walkthrough.truth.intrinsics[chosen], walkthrough.clip.color_size)
    seen = TriangleSurface(pieces[surfaces.seen_by(RayCaster(true), pieces.mean(1), *camera)])
    surface = TriangleSurface(ours.vertices[ours.faces].astype(np.float64))
    metrics.put("reconstruction/scene_chamfer_m", chamfer(surface, seen, SCENE_POINTS, rng))
    return metrics
