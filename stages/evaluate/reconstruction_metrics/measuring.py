"""Ask every subject but behavior for its metrics, one after the other."""

from collections.abc import Sequence

import numpy as np

from pipeline.core import devices, progress
from pipeline.core.videos import Video
from pipeline.data import flow
from pipeline.data.clips import PEOPLE, Masks
from pipeline.data.poses import RegisteredPoses
from pipeline.data.templates import SceneCameras
from pipeline.geometry import subsampling
from pipeline.localization import localizer as localizers
from pipeline.metrics.metrics import Metrics
from pipeline.metrics.pose_errors import PoseErrors, joined, pose_errors
from stages.evaluate import (
    clicked,
    heldout,
    localizing,
    perception,
    reading,
    real_phone,
    reconstruction,
    registration,
)
from stages.evaluate.config import Config
from stages.evaluate.reading import BuildFolders, RecordingWithTruth, TruthAlignment
from stages.evaluate.reliability import reliability_metrics
from stages.evaluate.truth import read_flow

MAP_FRAMES = 60
"""Walk-through frames that the localizer's baselines may use: one in eight of a minute."""
NO_TRUTH = "the true poses of this capture are not known"
NEED_TRUTH = (
    *clicked.NAMES, "localizer/rotation_deg_median", "localizer/translation_m_median", "masks/iou_mean",
    "masks/iou_resting", "flow/epe_px_mean",
)  # fmt: skip


def against_clicks(
    folders: BuildFolders, videos: tuple[Video, ...], config: Config, device: devices.Device
) -> Metrics:
    """Measure a real capture: registration by clicks, held-out views by the phone's own sensor."""
    metrics, cameras = Metrics(), {}
    sessions = [video for video in videos if video.role == "session"]
    registered = sum((folders.registration / video.id / "poses.npz").exists() for video in sessions)
    metrics.put("registration/videos_registered", registered)
    metrics.put("registration/videos_total", len(sessions))
    metrics.skip(NEED_TRUTH + reconstruction.NAMES, NO_TRUTH)
    if folders.clicks is None:
        metrics.skip(clicked.NAMES + clicked.OWN_NAMES, clicked.NO_CLICKS)
    else:
        progress.log("evaluate: clicks")
        cameras = clicked.cameras_from_clicks(folders.clicks, folders, videos)
        metrics.add(clicked.clicked_metrics(cameras, folders, videos))
    seen, sources = [], []
    for video in (video for video in videos if video.role == "heldout" and video.synchronized_with):
        placed = real_phone.cameras_of(folders, video, cameras.get(video.id), device)
        sources.append(placed[1] if placed else real_phone.UNPLACED)
        shots = real_phone.shots(folders, video, placed[0], config.heldout_frames) if placed else []
        seen.append((video.synchronized_with, shots))
    if sources:
        progress.log("evaluate: held-out phone")
        metrics.add(reconstruction.held_out_metrics(folders, seen, device, config.lpips_weights))
        if all(where == real_phone.UNPLACED for where in sources):
            metrics.skip(heldout.NAMES, real_phone.UNPLACED)
        else:
            metrics.skip(real_phone.PARTS_WITHOUT_MASKS, real_phone.NO_MASKS)
        metrics.skip(["reconstruction/heldout_cameras"], f"from {'; '.join(sources)}")
    return metrics


def against_truth(
    folders: BuildFolders, videos: tuple[Video, ...], config: Config, device: devices.Device
) -> Metrics:
    """Measure a capture whose truth is known: registration, single frames, masks, flow, reconstruction."""
    metrics, known = Metrics(), reading.recorded(folders, videos)
    frames, sessions = reading.frames_of_truth(folders, known), reading.of_role(known, "session")
    progress.log("evaluate: registration")
    metrics.add(_registration(folders, sessions, frames))
    progress.log("evaluate: single frames")
    walkthrough = reading.of_role(known, "walkthrough")[0]
    metrics.add(_single_frames(folders, walkthrough, sessions, frames, config, device))
    progress.log("evaluate: masks and flow")
    metrics.add(_perception(folders, sessions, reading.of_role(known, "turnaround")[0]))
    progress.log("evaluate: reconstruction")
    rng = np.random.default_rng(config.seed)
    metrics.add(reconstruction.reconstruction_metrics(folders, known, frames, config, rng, device))
    return metrics


def _registration(
    folders: BuildFolders, sessions: Sequence[RecordingWithTruth], frames: TruthAlignment
) -> Metrics:
    cameras, roots, confidence, root_confidence, registered = {}, [], {}, [], 0
    for each in sessions:
        poses = RegisteredPoses.open(folders.registration / each.video.id)
        registered += poses is not None
        ours = poses or RegisteredPoses.unknown(each.clip.timestamp_s)
        cameras[each.video.id] = pose_errors(ours.world_from_camera, frames.cameras(each.truth))
        confidence[each.video.id] = ours.confidence
        root = pose_errors(ours.world_from_agent, frames.roots(each.truth))
        roots.append(root[each.truth.agent_visible])
        root_confidence.append(np.nan_to_num(ours.agent_confidence)[each.truth.agent_visible])
    metrics = registration.camera_metrics(cameras, confidence, registered)
    metrics.add(registration.root_metrics("registration", roots))
    right = registration.is_right(joined(roots), registration.GOOD_ROOT)
    certain = np.concatenate(root_confidence) if root_confidence else np.zeros(0)
    metrics.add(reliability_metrics("registration/agent", certain, right))
    return metrics


def _single_frames(
    folders: BuildFolders,
    walkthrough: RecordingWithTruth,
    sessions: Sequence[RecordingWithTruth],
    frames: TruthAlignment,
    config: Config,
    device: devices.Device,
) -> Metrics:
    """Place single frames by our localizer and by its baseline."""
    cameras = SceneCameras.open(folders.scene_template)
    mapped = subsampling.some(np.flatnonzero(cameras.registered), MAP_FRAMES).tolist()
    ours = localizers.load(folders.scene_localizer, device)
    sift = localizing.sift_map(walkthrough.clip, cameras.world_from_camera, mapped)
    errors: dict[str, list[PoseErrors]] = {"localizer/": [], "localizer/sift_only_": []}
    probabilities = []
    for each in sessions:
        chosen = subsampling.evenly(len(each.clip), config.localizer_frames).tolist()
        masks = Masks.open(folders.masks[each.video.id])
        hidden = [masks[frame] > 0 for frame in chosen]
        answers, probability = localizing.placed_by_localizer(ours, each.clip, chosen, hidden)
        probabilities.append(probability)
        placed = {
            "localizer/": answers,
            "localizer/sift_only_": localizing.placed_by_sift(sift, each.clip, chosen),
        }
        for name, found in placed.items():
            errors[name].append(pose_errors(found, frames.cameras(each.truth)[chosen]))
    metrics = Metrics()
    for name, parts in errors.items():
        metrics.add(localizing.metrics_of(name, joined(parts)))
    right = registration.is_right(joined(errors["localizer/"]))
    certain = np.concatenate(probabilities) if probabilities else np.zeros(0)
    metrics.add(reliability_metrics("localizer", certain, right))
    return metrics


def _perception(
    folders: BuildFolders, sessions: Sequence[RecordingWithTruth], turnaround: RecordingWithTruth
) -> Metrics:
    seen = {
        each.video.id: perception.overlaps(Masks.open(folders.masks[each.video.id]), each.truth)
        for each in (*sessions, turnaround)
    }
    pairs = []
    for each in sessions:
        true = read_flow(folders.truth_folder, each.name, each.source_index)
        if true is not None:
            forward = flow.open_flow(folders.flow[each.video.id], 1)
            pairs.append((forward, true, each.truth.masks))
    metrics = perception.mask_metrics([seen[each.video.id] for each in sessions], seen[turnaround.video.id])
    metrics.add(perception.flow_metrics(pairs))
    tracks = [(each.truth, folders.masks[each.video.id] / "people.npz") for each in sessions]
    found = [(truth, PEOPLE.load(path)) for truth, path in tracks if path.exists()]
    metrics.add(perception.people_metrics(found))
    return metrics
