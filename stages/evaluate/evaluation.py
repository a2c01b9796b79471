"""Ask every subject for its figures, one after the other."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline import progress
from pipeline.files import arrays
from pipeline.files.clips import Masks
from pipeline.models import localizer as localizers
from pipeline.models.behavior import Sampling
from pipeline.models.predictors import Ats
from pipeline.models.scenes import Scenes
from pipeline.models.trajectories import BehaviorData
from pipeline.videos import Video
from stages.evaluate import (
    behavior,
    clicked,
    heldout,
    localizing,
    perception,
    physical,
    reading,
    real_phone,
    reconstruction,
    registration,
    speed,
)
from stages.evaluate.alignment import PoseErrors, joined, pose_errors
from stages.evaluate.behavior import Protocol
from stages.evaluate.figures import Figures
from stages.evaluate.reading import Folders, Frames, Recorded
from stages.evaluate.reliability import reliability_figures
from stages.evaluate.truth import read_flow

NO_TRUTH = "the true poses of this capture are not known"
NEED_TRUTH = (
    *(f"registration/{unit}_{which}" for unit in ("rotation_deg", "translation_m") for which in ("median", "p95")),
    "localizer/rotation_deg_median", "localizer/translation_m_median", "masks/iou_mean", "masks/iou_resting",
    "flow/epe_px_mean",
)  # fmt: skip


@dataclass(frozen=True)
class Effort:
    """How much is looked at; see the stage's configuration."""

    localizer_frames: int
    map_frames: int
    heldout_frames: int
    surface_frames: int
    physical_windows: int
    time_plans: bool


def evaluate(folders: Folders, videos: Sequence, effort: Effort, protocol: Protocol, rng: np.random.Generator, device: str) -> Figures:
    """Return all figures of a build."""
    figures = Figures()
    if folders.truth is None:
        sessions = [video for video in videos if video.role == "session"]
        placed = sum((folders.registration / video.id / "poses.npz").exists() for video in sessions)
        figures.put("registration/videos_registered", placed)
        figures.put("registration/videos_total", len(sessions))
        figures.skip(NEED_TRUTH + reconstruction.NAMES, NO_TRUTH)
        figures.add(_against_clicks(folders, tuple(videos), effort, device))
    else:
        figures.add(_against_truth(folders, videos, effort, rng, device))
    progress.log("evaluate: behaviour")
    data = BehaviorData.load(folders.behavior_data)
    ours = _predictor(folders, data, device)
    figures.add(behavior.behavior_figures(data, ours, protocol))
    progress.log("evaluate: penetration and foot slide")
    figures.add(physical.physical_figures(data, ours, folders.reconstruction, windows=effort.physical_windows, seed=protocol.seed))
    figures.add(speed.plan_figures(data, _predictor(folders, data, "cpu"), protocol.seed, measure=effort.time_plans))
    return figures


def _against_clicks(folders: Folders, videos: tuple[Video, ...], effort: Effort, device: str) -> Figures:
    """Measure a real capture: registration by clicks, held-out views by the phone itself, placed by clicks or registration."""
    figures, cameras = Figures(), {}
    if folders.clicks is None:
        figures.skip(clicked.NAMES + clicked.OWN_NAMES, clicked.NO_CLICKS)
    else:
        progress.log("evaluate: clicks")
        cameras = clicked.cameras_from_clicks(folders.clicks, folders, videos)
        figures.add(clicked.clicked_figures(cameras, folders, videos))
    seen, told = [], []
    for video in (video for video in videos if video.role == "heldout" and video.synchronized_with):
        placed = real_phone.cameras_of(folders, video, cameras.get(video.id))
        told.append(placed[1] if placed else real_phone.UNPLACED)
        seen.append((video.synchronized_with, real_phone.shots(folders, video, placed[0], effort.heldout_frames) if placed else []))
    if told:
        progress.log("evaluate: held-out phone")
        figures.add(reconstruction.held_out_figures(folders, seen, device))
        nowhere = all(where == real_phone.UNPLACED for where in told)
        figures.skip(*((heldout.NAMES, real_phone.UNPLACED) if nowhere else (real_phone.PARTS_WITHOUT_MASKS, real_phone.NO_MASKS)))
        figures.skip(["reconstruction/heldout_cameras"], f"from {'; '.join(told)}")
    return figures


def _against_truth(folders: Folders, videos: Sequence, effort: Effort, rng: np.random.Generator, device: str) -> Figures:
    figures, known = Figures(), reading.recorded(folders, tuple(videos))
    role = {name: [each for each in known if each.video.role == name] for name in ("walkthrough", "turnaround", "session", "heldout")}
    walkthrough, turnaround = role["walkthrough"][0], role["turnaround"][0]
    frames = reading.frames_of_truth(folders, walkthrough, turnaround)
    sessions = role["session"]
    for label, part in (
        ("registration", lambda: _registration(folders, sessions, frames)),
        ("single frames", lambda: _single_frames(folders, walkthrough, sessions, frames, effort)),
        ("masks and flow", lambda: _perception(folders, sessions, turnaround)),
        ("reconstruction", lambda: reconstruction.reconstruction_figures(
            folders, known, frames, reconstruction.Effort(effort.heldout_frames, effort.surface_frames), rng, device)),
    ):  # fmt: skip
        progress.log(f"evaluate: {label}")
        figures.add(part())
    return figures


def _registration(folders: Folders, sessions: Sequence[Recorded], frames: Frames) -> Figures:
    cameras, roots, confidence, registered = {}, [], {}, 0
    for each in sessions:
        poses = reading.read_registration(folders.registration, each.video.id)
        registered += poses is not None
        unknown = np.full((len(each.clip), 4, 4), np.nan)
        ours = poses or {
            "world_from_camera": unknown,
            "world_from_agent": unknown,
            "confidence": np.zeros(len(unknown)),
        }
        cameras[each.video.id] = pose_errors(ours["world_from_camera"], frames.cameras(each.truth))
        confidence[each.video.id] = ours["confidence"]
        root = pose_errors(ours["world_from_agent"], frames.roots(each.truth))
        roots.append(root[each.truth.agent_visible])
    figures = registration.camera_figures(cameras, confidence, registered)
    figures.add(registration.root_figures("registration", roots))
    return figures


def _single_frames(folders: Folders, walkthrough: Recorded, sessions: Sequence[Recorded], frames: Frames, effort: Effort) -> Figures:
    """Place single frames by our localizer and by its rivals."""
    table = arrays.load(folders.scene_template / "cameras.npz")
    mapped = np.flatnonzero(table["registered"])
    mapped = mapped[np.unique(np.linspace(0, len(mapped) - 1, effort.map_frames).astype(int))]
    ours = localizers.load(folders.scene_localizer)
    sift = localizing.sift_map(walkthrough.clip, table["world_from_camera"], mapped)
    pictures = localizing.gallery(walkthrough.clip, table["world_from_camera"], mapped)
    errors: dict[str, list[PoseErrors]] = {name: [] for name in ("localizer/", "localizer/sift_only_", "localizer/retrieval_only_")}
    told = []
    for each in sessions:
        chosen = np.unique(np.linspace(0, len(each.clip) - 1, effort.localizer_frames).astype(int)).tolist()
        masks = Masks.open(folders.masks[each.video.id])
        hidden = [masks[frame] > 0 for frame in chosen]
        answers, probability = localizing.placed_by_localizer(ours, each.clip, chosen, hidden)
        told.append(probability)
        placed = {
            "localizer/": answers,
            "localizer/sift_only_": localizing.placed_by_sift(sift, each.clip, chosen),
            "localizer/retrieval_only_": localizing.placed_by_retrieval(pictures, each.clip, chosen),
        }
        for name, found in placed.items():
            errors[name].append(pose_errors(found, frames.cameras(each.truth)[chosen]))
    figures = Figures()
    for name, parts in errors.items():
        figures.add(localizing.figures_of(name, joined(parts)))
    right = registration.is_right(joined(errors["localizer/"]))
    figures.add(reliability_figures("localizer", np.concatenate(told) if told else np.zeros(0), right))
    return figures


def _perception(folders: Folders, sessions: Sequence[Recorded], turnaround: Recorded) -> Figures:
    seen = {each.video.id: perception.overlaps(Masks.open(folders.masks[each.video.id]), each.truth) for each in (*sessions, turnaround)}
    pairs = []
    for each in sessions:
        true = read_flow(folders.truth, each.name, each.source_index)
        if true is not None:
            flow = arrays.load(folders.flow[each.video.id] / "flow_1_fw.npz", ("flow",))["flow"]
            pairs += perception.flow_pairs(flow, true, each.truth.masks)
    figures = perception.mask_figures([seen[each.video.id] for each in sessions], seen[turnaround.video.id])
    figures.add(perception.flow_figures(pairs))
    return figures


def _predictor(folders: Folders, data: BehaviorData, device: str) -> Ats:
    """Open the behaviour model as a predictor on its own windows."""
    return Ats.load(folders.behavior, Scenes.load(folders.behavior_data, data.videos), Sampling(), device=device)
