"""Measure the registrations of several variants frame by frame, and compare them in pairs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.core.videos import Video
from pipeline.data.clips import FRAMES
from pipeline.data.poses import RegisteredPoses
from pipeline.data.qa import Check
from pipeline.data.templates import SceneCameras
from pipeline.metrics.intervals import aligned, bootstrapped, episodes, formatted_interval
from pipeline.metrics.metrics import Metrics, formatted, median
from pipeline.metrics.pose_errors import PoseErrors, constant_between, joined, pose_errors
from stages.evaluate import registration
from stages.evaluate.truth import RecordingTruth

PAPER = {
    "ours": (6.35, 0.41),
    "no_localizer": (37.59, 0.83),
    "no_feature_metric": (22.47, 1.30),
    "totalrecon": (59.19, 0.68),
}
"""Rotation (degrees) and translation (meters) on the paper's own cat videos (Table 1)"""
NAMES = {
    "ours": "ours",
    "no_localizer": "without localizer",
    "no_feature_metric": "without feature-metric alignment",
    "no_odometry": "without odometry",
    "regression_only": "regression only",
    "totalrecon": "TotalRecon, all videos",
}
TITLE = (
    "Table 1: camera registration, all frames of all sessions (median; 95th percentile; mean difference to "
    "ours with 95 % interval)"
)
FOOTNOTE = "paper: on its own cat videos; '-': more than half (a twentieth) of the frames has no pose."
EPISODE_S = 5.0
"""Intervals resample stretches of this length together: poses of neighboring frames err alike."""
MAX_DEG, MAX_M = 180.0, 10.0
"""A frame without a pose counts as this wrong where errors are averaged"""
UNITS = {"rotation_deg": "degrees", "translation_m": "meters"}


@dataclass(frozen=True)
class _Session:
    id: str
    camera: Float[np.ndarray, "frame 4 4"]
    """true, in our world"""
    timestamp_s: Float[np.ndarray, "frame"]


def metrics(
    folders: Mapping[str, Path],
    frames: Mapping[str, Path],
    videos: Sequence[Video],
    scene_template: Path,
    truth: Path | None,
    rng: np.random.Generator,
) -> Metrics:
    """Return ``<variant>/<figure>`` of every variant, and what each changes against ours, with intervals."""
    found = Metrics()
    if truth is None:
        names = ("rotation_deg_median", "rotation_deg_p95", "translation_m_median", "translation_m_p95")
        unknown = "the true poses of this capture are not known"
        found.skip([f"{variant}/{name}" for variant in folders for name in names], unknown)
        return found
    sessions = _sessions(frames, videos, scene_template, truth)
    errors: dict[str, list[PoseErrors]] = {}
    for variant, folder in folders.items():
        named, confidence, registered = {}, {}, 0
        for session in sessions:
            poses = RegisteredPoses.open(folder / session.id)
            registered += poses is not None
            poses = poses or RegisteredPoses.unknown(session.timestamp_s)
            named[session.id] = pose_errors(poses.world_from_camera, session.camera)
            confidence[session.id] = poses.confidence
        errors[variant] = list(named.values())
        one = registration.camera_metrics(named, confidence, registered)
        for id, error in named.items():
            for unit, name in UNITS.items():
                value = median(getattr(error, name))
                found.put(f"{variant}/{id}/{unit}_median", value, registration.REFUSED)
        found.add_as(variant, one, "registration")
    for variant in folders:
        if variant != "ours":
            _compare(found, variant, sessions, errors, rng)
    return found


def _compare(
    found: Metrics,
    variant: str,
    sessions: Sequence[_Session],
    errors: Mapping[str, Sequence[PoseErrors]],
    rng: np.random.Generator,
) -> None:
    """Put the paired mean differences to ours with 95 % intervals, over all sessions and over each."""
    parts = {f"{variant}/{session.id}": [index] for index, session in enumerate(sessions)}
    for name, part in ({variant: list(range(len(sessions)))} | parts).items():
        start = np.concatenate([(sessions[index].timestamp_s / EPISODE_S).astype(int) for index in part])
        video = np.repeat(part, [len(sessions[index].timestamp_s) for index in part])
        both = [joined([errors[which][index] for index in part]) for which in (variant, "ours")]
        for unit, most in (("rotation_deg", MAX_DEG), ("translation_m", MAX_M)):
            theirs, ours = (np.minimum(getattr(each, UNITS[unit]), most) for each in both)
            interval = bootstrapped(theirs - ours, episodes(start, video, 1), rng)
            found.put_mean(f"{name}/{unit}_more_than_ours", interval)


def _sessions(frames, videos, scene_template, truth) -> list[_Session]:
    ours = SceneCameras.open(scene_template).world_from_registered
    tables = {
        id: FRAMES.load(folder / "frames.npz", "source_index", "timestamp_s") for id, folder in frames.items()
    }
    true = {
        video.id: RecordingTruth.open(truth, Path(video.file).stem, tables[video.id]["source_index"])
        for video in videos
        if video.id in tables
    }
    walk = next(video.id for video in videos if video.role == "walkthrough")
    world = constant_between(ours, true[walk].world_from_camera)
    chosen = [video.id for video in videos if video.role == "session"]
    return [_Session(id, world @ true[id].world_from_camera, tables[id]["timestamp_s"]) for id in chosen]


def text(values: Mapping[str, float | None], variants: Sequence[str]) -> str:
    """Lay the metrics out as Table 1, the paper's beside ours."""
    rows = [["", "rotation, deg", "translation, m", "videos", "to ours, deg", "paper"]]
    for variant in variants:
        pairs = [
            "; ".join(formatted(values.get(f"{variant}/{unit}_{which}")) for which in ("median", "p95"))
            for unit in UNITS
        ]
        counts = (values.get(f"{variant}/videos_{which}") for which in ("registered", "total"))
        videos = "/".join(formatted(count, "g") for count in counts)
        against = formatted_interval(values, f"{variant}/rotation_deg_more_than_ours", ".3f")
        paper = "{:g} / {:g}".format(*PAPER[variant]) if variant in PAPER else ""
        rows.append([_name(variant), *pairs, videos, "" if variant == "ours" else against, paper])
    parts = [aligned(TITLE, rows)]
    sessions = sorted({name.split("/")[1] for name in values if name.count("/") == 2})
    if sessions:
        rows = [["", *sessions]]
        for variant in variants:
            medians = (values.get(f"{variant}/{id}/rotation_deg_median") for id in sessions)
            rows.append([_name(variant), *map(formatted, medians)])
        parts.append(aligned("per session: median deg", rows))
        rows = [["", *sessions]]
        for variant in (each for each in variants if each != "ours"):
            names = (f"{variant}/{id}/translation_m_more_than_ours" for id in sessions)
            rows.append([_name(variant), *(formatted_interval(values, name, ".1f", 1000) for name in names)])
        parts.append(aligned("per session: mean difference to ours, mm", rows))
    return "\n\n".join([*parts, FOOTNOTE]) + "\n"


def _name(variant: str) -> str:
    return NAMES.get(variant, variant)


def checks(values: Mapping[str, float | None], variants: Sequence[str]) -> list[Check]:
    """Judge whether what the ablations leave out matters."""
    ours = values.get("ours/rotation_deg_median")
    without = values.get("no_localizer/rotation_deg_median")
    ratio = None if ours is None else (without if without is not None else MAX_DEG) / max(ours, 1e-6)
    found = [Check("rotation, ours", ours, "deg, median", 0.5, 2.0)]
    if "no_localizer" in variants:
        found.append(Check("rotation without localizer over ours", ratio, "", 3.0, None, "higher"))
    return found
