"""Descriptions of the metrics of `metrics.json` for readers."""

import re
from typing import Any, NamedTuple

SUBJECTS = {
    "agent": "animal's root",
    "ats": "ours",
    "recorded": "recorded motion",
    "location_prior": "location prior",
    "stand_still": "standing still",
    "constant_velocity": "constant velocity",
}
"""Methods and sources of motion."""
SUFFIXES = {"_ci95_low": "lower end of the 95 % interval", "_ci95_high": "upper end of the 95 % interval"}
UNITS = {"_m_s": "m/s", "_deg": "deg", "_rad": "rad", "_px": "px", "_m": "m", "_s": "s"}
STATISTICS = {"_median": "median", "_mean": "mean", "_p90": "90th percentile", "_p95": "95th percentile"}
PARTS = {"_all": "whole picture", "_agent": "animal", "_scene": "room"}
COVERED = re.compile(r"at_coverage_(\d+)_(.*)")
STEMS = {
    "agent_chamfer": "chamfer distance of the animal's surface",
    "agent_chamfer_share": "share of frames in which the animal's surface was compared",
    "agent_flips_share": "share of animal poses with front and back confused",
    "agent_placed_share": "share of frames in which the animal is placed",
    "agent_root": "error of the animal's root",
    "agent_track": "error of points followed on the animal",
    "calibration_error": "calibration error of the confidence",
    "clicked_frames": "frames with clicked correspondences",
    "clicked_residual": "disagreement of clicks",
    "confidence": "confidence",
    "contact_share": "share of frames with a foot on the ground",
    "agent_filmed_share": "share of the held-out pictures of the animal in which its session films it too",
    "depth_acc": "depth within 0.1 m",
    "depth_acc_agent_filmed": "depth within 0.1 m, animal, while the session films it",
    "epe": "end-point error of the flow",
    "foot_slide": "foot skate, slowest foot near the scene",
    "goal_energy_score": "energy score of goals",
    "goal_minde": "goal error, best of 16",
    "heldout_cameras": "source of the held-out phone's cameras",
    "heldout_frames": "frames of the held-out phone",
    "heldout_phones_drawn": "held-out phones rendered",
    "heldout_phones_total": "held-out phones",
    "iou": "overlap (IoU)",
    "iou_resting": "overlap (IoU) while the animal rests",
    "iou_turnaround": "overlap (IoU) in the turnaround",
    "joints_minade": "joint error, best of 16",
    "lpips": "LPIPS",
    "measured_by": "measured by",
    "moving_windows_share": "share of windows in which the animal moves",
    "non_collision_share": "share of frames without collision",
    "orientation_minade": "orientation error, best of 16",
    "path_minade": "path error, best of 16",
    "penetration": "depth of the body inside the scene",
    "physical_windows": "windows in which penetration and foot skate are measured",
    "plan_50": "time of a plan in 50 steps",
    "plan_few": "time of a plan in few steps",
    "plan_trials": "trials of paths and bodies",
    "plan_windows": "windows in which paths and bodies are judged",
    "psnr": "PSNR",
    "rotation": "rotation error",
    "scene_chamfer": "chamfer distance of the room's surface",
    "ssim": "SSIM",
    "test_windows": "test windows",
    "translation": "position error",
    "unknown_share": "share of the animal's pixels that masks leave unknown",
    "videos_registered": "sessions registered",
    "videos_total": "sessions",
    "within_2deg_5cm_share": "share within 2 deg and 5 cm",
    "within_5deg_20cm_share": "share within 5 deg and 20 cm",
    "zero_flow_epe": "end-point error of predicting no motion",
}  # fmt: skip
METHODS = {
    "rendered_": "volume rendering",
    "sift_only_": "SIFT and PnP",
    "agent_confidence_": "animal's root",
}
"""Prefixes of metrics that name the method."""


class MetricWords(NamedTuple):
    """One metric in words."""

    text: str
    unit: str


def describe(key: str) -> MetricWords:
    """Return the words and the unit of a key of `metrics.json`; the group before the first slash is left out.

    An unknown key keeps its own words, underscores as spaces.
    """
    _, *subjects, name = key.split("/")
    parts = [subject.split("_minus_") for subject in subjects]
    words = [" less ".join(SUBJECTS.get(each, each) for each in part) for part in parts]
    ending = next((suffix for suffix in SUFFIXES if name.endswith(suffix)), "")
    name, tail = name.removesuffix(ending), [SUFFIXES[ending]] if ending else []
    covered = COVERED.fullmatch(name)
    if covered:
        name, tail = covered[2], [f"{covered[1]} % most confident frames", *tail]
    method = next((begin for begin in METHODS if name.startswith(begin)), "")
    words += [METHODS[method]] if method else []
    name = name.removeprefix(method)
    unit = ""
    if name not in STEMS:
        for endings in (STATISTICS, PARTS, UNITS):
            found = next((each for each in endings if name.endswith(each)), "")
            name = name.removesuffix(found)
            if found and endings is UNITS:
                unit = endings[found]
            elif found:
                tail.insert(0, endings[found])
    unit = unit or ("px" if name.startswith("epe_px") else "dB" if name == "psnr" else "")
    words.append(STEMS.get(name, name.replace("_", " ")))
    return MetricWords(", ".join([": ".join(words), *tail]), unit)


def number(value: Any) -> str:
    """Format a number with three significant digits, without exponent if possible."""
    if value is None:
        return "–"
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value)
    if value == round(value) or abs(value) >= 100:
        return f"{value:.0f}"
    return f"{value:#.3g}".rstrip(".") if abs(value) >= 1e-3 else f"{value:.1e}"
