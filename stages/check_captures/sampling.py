"""Sample a recording: a few dozen upright frames spread over it, and what can be measured without a map."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.calibration import recordings as calibration
from pipeline.calibration.given import NOTHING, GivenCalibration
from pipeline.calibration.recordings import DepthCalibration
from pipeline.geometry import rigid
from pipeline.geometry.subsampling import evenly
from pipeline.mapping.picture_agreement import PictureAgreement
from pipeline.recordings import errors, extraction
from pipeline.recordings.extraction import BLURRED_SHARE, MIN_FRAMES, ExtractionPlan
from pipeline.recordings.recording import Recording

RATE_HZ, SIDE_PX = 10.0, 640
"""of the pictures"""
DEPTH_SIDE_PX = 192
"""longer side of the sampled depth"""
MIN_DEPTH_VALID = 0.2
"""share of known depth below which a build leaves a frame out (`[extract_frames] min_depth_valid`)"""
BLURRED = 4.0
"""absolute sharpness below which a picture is blurred"""


@dataclass(frozen=True)
class SampledFrame:
    """One sampled frame, upright."""

    timestamp_s: float
    gray: UInt8[np.ndarray, "height width"]
    sharpness: float
    brightness: float
    intrinsics: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    depth: Float[np.ndarray, "depth_height depth_width"] = field(default_factory=lambda: np.zeros((0, 0)))
    """meters, 0 = unknown"""
    depth_intrinsics: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    odometry_from_camera: Float[np.ndarray, "4 4"] | None = None
    beyond: float = 0.0
    """share of the depth that is known but beyond the sensor's range"""

    @property
    def camera_from_odometry(self) -> Float[np.ndarray, "4 4"]:
        """The inverse of the device pose, which must be known."""
        assert self.odometry_from_camera is not None, "the recording has no poses"
        return rigid.inverse(self.odometry_from_camera)


@dataclass(frozen=True)
class RecordingSample:
    """A sample of a recording."""

    recording: Recording
    plan: ExtractionPlan | None
    """None for a recording without depth"""
    shots: Sequence[SampledFrame]
    damaged: float
    """share of the sample (0..1) that cannot be decoded"""
    agreement: PictureAgreement | None = None
    """of pictures with depth, intrinsics and device poses"""
    calibration: DepthCalibration | None = None
    """of the depth camera, which is applied in ``recording`` as far as it is used"""

    @property
    def duration_s(self) -> float:
        """Seconds from the first to the last frame."""
        return float(self.recording.timestamp_s[-1] - self.recording.timestamp_s[0])

    @property
    def rate_hz(self) -> float:
        """Typical frames per second."""
        steps = np.diff(self.recording.timestamp_s)
        return float(1 / np.median(steps)) if len(steps) else 0.0

    @property
    def longest_gap_s(self) -> float:
        """Longest time between two recorded frames."""
        return float(np.diff(self.recording.timestamp_s).max(initial=0.0))

    @property
    def dark(self) -> float:
        """Share of dark pictures, 0..1."""
        return float(np.mean([shot.brightness < extraction.DARK for shot in self.shots]))

    @property
    def blurred(self) -> float:
        """Share of blurred pictures, 0..1: relative to the recording, or absolutely."""
        sharpness = np.array([shot.sharpness for shot in self.shots])
        return float((sharpness < max(BLURRED_SHARE * float(np.median(sharpness)), BLURRED)).mean())

    @property
    def depth_valid(self) -> float:
        """Share of known depth, 0..1; 0 without depth."""
        return float(np.mean([(shot.depth > 0).mean() if shot.depth.size else 0.0 for shot in self.shots]))

    @property
    def depth_m(self) -> float:
        """Median depth, meters; NaN without any."""
        known = np.concatenate([shot.depth[shot.depth > 0] for shot in self.shots] or [np.zeros(0)])
        return float(np.median(known)) if len(known) else np.nan

    @property
    def beyond(self) -> float:
        """Share of depth beyond the sensor's range, 0..1."""
        return float(np.mean([shot.beyond for shot in self.shots]))


def sample(
    recording: Recording, count: int, *, max_depth_m: float, given: GivenCalibration = NOTHING
) -> RecordingSample:
    """Read about ``count`` frames spread over a recording; `InputError` if it is unusable."""
    if recording.depth_size is None:
        return _look_at_pictures(recording, count)
    calibrated, plan = calibration.understand(
        recording, given, rate_hz=RATE_HZ, max_depth_m=max_depth_m, max_side_px=SIDE_PX
    )
    recording = calibrated.recording
    rows, shots = evenly(len(plan.chosen), count, rounded=True), []
    sample = replace(plan, chosen=plan.chosen[rows])
    frames = extraction.frames(recording, sample, max_depth_m=max_depth_m)
    for row, frame in zip(rows, frames, strict=True):
        if frame is not None:
            raw = recording.read_depth(int(recording.index[plan.chosen[row]]))
            beyond = float((np.isfinite(raw) & (raw >= max_depth_m)).mean())
            shots.append(_shot(plan, row, frame, beyond))
    _refuse_empty(recording, shots)
    usable = sum(float((shot.depth > 0).mean()) >= MIN_DEPTH_VALID for shot in shots)
    if usable * len(plan.chosen) < MIN_FRAMES * len(rows):
        why = f"{MIN_DEPTH_VALID:.0%} of the depth is known in {usable} of {len(rows)} sampled frames"
        raise errors.no_frames(recording.where, why)
    agreement = extraction.picture_agreement_of(recording, plan, max_depth_m=max_depth_m)
    return RecordingSample(recording, plan, shots, 1 - len(shots) / len(rows), agreement, calibrated)


def _shot(plan: ExtractionPlan, row: int, frame: extraction.ExtractedFrame, beyond: float) -> SampledFrame:
    step = max(1, max(frame.depth.shape) // DEPTH_SIDE_PX)
    depth = frame.depth[step // 2 :: step, step // 2 :: step]
    intrinsics = plan.depth_intrinsics[row].copy()
    intrinsics[:2, 2] -= step // 2 + 0.5
    intrinsics[:2] /= step
    intrinsics[:2, 2] += 0.5
    return SampledFrame(
        timestamp_s=float(plan.timestamp_s[row]),
        gray=cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY),
        intrinsics=plan.intrinsics[row],
        depth=depth,
        depth_intrinsics=intrinsics,
        odometry_from_camera=None if plan.odometry_from_camera is None else plan.odometry_from_camera[row],
        sharpness=frame.sharpness,
        brightness=frame.brightness,
        beyond=beyond,
    )


def _look_at_pictures(recording: Recording, count: int) -> RecordingSample:
    chosen, shots = extraction.choose_frames(recording.timestamp_s, RATE_HZ), []
    rows = chosen[evenly(len(chosen), count, rounded=True)]
    for row in rows.tolist():
        color = extraction.picture(recording, row)
        if color is not None:
            gray, statistics = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), extraction.picture_statistics(color)
            shots.append(SampledFrame(float(recording.timestamp_s[row]), gray, *statistics))
    _refuse_empty(recording, shots)
    return RecordingSample(recording, None, shots, 1 - len(shots) / len(rows))


def _refuse_empty(recording: Recording, shots: Sequence[SampledFrame]) -> None:
    if not shots:
        raise errors.damaged(recording.where, "none of the sampled pictures can be decoded")
    if len(shots) < MIN_FRAMES:
        raise errors.no_frames(recording.where, f"{len(shots)} pictures, {MIN_FRAMES} are the least")
