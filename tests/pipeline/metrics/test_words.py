"""Metric keys are formatted as words."""

import pytest

from pipeline.metrics.words import describe


@pytest.mark.parametrize(
    ("key", "text", "unit"),
    [
        ("behavior/ats_minus_stand_still/goal_minde_m_ci95_low", (
"ours less standing still: goal error, best of "
"16, lower end of the 95 % interval"
), "m"),
        ("registration/rotation_deg_p95", "rotation error, 95th percentile", "deg"),
        ("registration/at_coverage_80_translation_m_median", (
"position error, median, 80 % "
"most confident frames"
), "m"),
        ("localizer/sift_only_rotation_deg_median", "SIFT and PnP: rotation error, median", "deg"),
        ("reconstruction/psnr_agent", "PSNR, animal", "dB"),
        ("reconstruction/agent_chamfer_share", (
"share of frames in which the animal's "
"surface was compared"
), ""),
        ("flow/epe_px_agent_mean", "end-point error of the flow, animal, mean", "px"),
        ("behavior/recorded/foot_slide_m_s", "recorded motion: foot skate, slowest foot near the scene", "m/s"),
        ("masks/iou_mean", "overlap (IoU), mean", ""),
        ("else/never_heard_of", "never heard of", ""),
    ],
)  # fmt: skip
def test_keys_are_formatted_as_words(key: str, text: str, unit: str):
    assert (describe(key).text, describe(key).unit) == (text, unit)
