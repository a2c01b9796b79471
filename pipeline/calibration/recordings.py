"""The depth camera of a recording: read some of its frames, estimate, decide whether it is clear, apply it.

`understand` does all of it. A correct recording stays as it is: an estimate counts as clear only if depth
moves by more than a pixel of a phone's depth, and if its steps then lie on edges of other frames
significantly more often.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.calibration import depth_steps, estimation
from pipeline.calibration.depth_steps import PARAMETERS, StepFrame, StepProfiles
from pipeline.calibration.estimation import ParameterFit
from pipeline.calibration.given import NOTHING, GivenCalibration, described
from pipeline.geometry import cameras, rigid
from pipeline.geometry.subsampling import evenly, nearest
from pipeline.mapping.edge_agreement import relative_slopes
from pipeline.mapping.picture_agreement import beats
from pipeline.recordings import extraction
from pipeline.recordings.extraction import ExtractionPlan
from pipeline.recordings.recording import DepthCamera, Recording

FRAMES, RATE_HZ = 90, 10.0
"""frames that are read, at most this many per second: two thirds for the estimate, the others confirm it"""
EVERY = 3
"""every third frame confirms; starts are searched in every third one of the others"""
SIDE_PX, FARTHEST_M = 640, 5.0
"""longer side of pictures, and range of depth"""
ROUNDS = 3
"""maximum linearizations with the same parameters"""
START_DELAYS_S = (0.0, -0.1, 0.1, -0.2, 0.2)
"""delays of depth that are tried to begin with, seconds"""
READ_AHEAD = 4
"""pictures that are kept in memory while depth is moved along with them"""
MAX_REST = 0.75
"""depth farther in time than this share of a frame's step is not used for a delayed recording"""
MIN_SHIFT = 1 / 192
"""smallest shift of depth that is corrected, share of the longer side: about a pixel of a phone's depth"""
SIGMAS = 5.0
"""an estimate is clear if larger than this many standard errors"""
MAX_FOCAL_ERROR, MAX_BASELINE_ERROR_M = 0.01, 0.01
"""maximum standard errors of a camera that is used"""
ROTATION = ("pitch", "yaw", "roll")
PARALLEL = tuple(name for name in PARAMETERS if name not in ROTATION)
CAMERA = PARAMETERS[:6]
PARTS = ("camera", "delay")
"""what may be corrected"""
_Sampled = tuple[int, StepFrame]
"""row of a frame in its recording, and the frame, still without depth"""


@dataclass(frozen=True)
class DepthEstimate:
    """The depth camera and clock that edges of pictures support."""

    focal: float
    """factor on the stated focal length of the depth camera"""
    depth_from_color: Float[np.ndarray, "4 4"]
    delay_s: float
    """depth shows what pictures showed this long before, seconds"""
    error: Float[np.ndarray, "parameter"]
    """standard errors of `PARAMETERS`, 0 where they are not estimated"""
    shift: float = 0.0
    """root mean square shift of depth from where it is stated to be, share of the picture's longer side"""
    shift_error: float = np.inf

    def camera_is_clear(self) -> bool:
        """Return whether the camera differs from the stated one by more than errors and a pixel of depth."""
        return bool(
            self.shift > MIN_SHIFT
            and self.shift > SIGMAS * self.shift_error
            and self.error[0] < MAX_FOCAL_ERROR
            and self.error[1:3].max() < MAX_BASELINE_ERROR_M
        )

    def delay_is_clear(self, step_s: float) -> bool:
        """Return whether another frame's depth fits better, frames being ``step_s`` apart."""
        return bool(abs(self.delay_s) > step_s / 2 + SIGMAS * self.error[PARAMETERS.index("delay")])


@dataclass(frozen=True)
class DepthCalibration:
    """What was estimated of a recording, and what of it is clear and used."""

    recording: Recording
    """with the depth camera and clock that are used"""
    estimate: DepthEstimate | None
    """None where too few steps of depth are seen"""
    clear: tuple[str, ...] = ()
    """`camera` and `delay`, as far as they differ clearly from what is stated"""
    used: tuple[str, ...] = ()
    applied_s: float = 0.0
    """given delay, which was applied before the rest of it was estimated"""


def understand(
    recording: Recording,
    given: GivenCalibration = NOTHING,
    *,
    rate_hz: float,
    max_depth_m: float,
    max_side_px: int,
) -> tuple[DepthCalibration, ExtractionPlan]:
    """Plan the extraction of a recording after what `calibrate` finds is applied.

    Raises what `extraction.understand` raises. Depth in another unit is not calibrated.
    """
    options = {"rate_hz": rate_hz, "max_depth_m": max_depth_m, "max_side_px": max_side_px}
    recording = with_given(recording, given)
    plan = extraction.understand(recording, **options)
    if plan.pose_check.depth_factor != 1:
        return DepthCalibration(recording, None), plan
    found = calibrate(recording, given)
    return found, extraction.understand(found.recording, **options) if found.used else plan


def with_given(recording: Recording, given: GivenCalibration) -> Recording:
    """Apply the depth camera and delay that are given. Raises CAP-004 for an impossible camera."""
    recording = described(recording, given)
    return _delayed(recording, given.delay_s) if given.delay_s else recording


def calibrate(recording: Recording, given: GivenCalibration = NOTHING) -> DepthCalibration:
    """Estimate depth camera and delay of a recording; use what is clear and not given."""
    step_s = float(np.median(np.diff(recording.timestamp_s))) if len(recording.index) > 1 else np.inf
    frames, others = _frames(recording)
    found = _estimated(recording, frames)
    if found is None:
        return DepthCalibration(recording, None)
    differs = {"camera": found.camera_is_clear(), "delay": found.delay_is_clear(step_s)}
    clear = tuple(name for name, differing in differs.items() if differing)
    if not clear or not _confirmed(recording, others, found, clear):
        return DepthCalibration(recording, found)
    given_camera = given.registered or recording.depth_camera is not None
    fixed = {"camera": given_camera, "delay": given.delay_s is not None}
    used = tuple(name for name in clear if not fixed[name])
    return DepthCalibration(_changed(recording, found, used), found, clear, used, given.delay_s or 0.0)


def _changed(recording: Recording, found: DepthEstimate, parts: Sequence[str]) -> Recording:
    recording = _delayed(recording, found.delay_s) if "delay" in parts else recording
    return _reprojected(recording, found) if "camera" in parts else recording


def _delayed(recording: Recording, delay_s: float) -> Recording:
    """Take the depth of the frame that was stored ``delay_s`` later; nothing is known where there is none.

    What remains, up to half a frame, is corrected by the motion of the picture.
    """
    rows = nearest(recording.timestamp_s, recording.timestamp_s + delay_s)
    newer_s = recording.timestamp_s[rows] - recording.timestamp_s - delay_s
    known = np.abs(newer_s) <= MAX_REST * float(np.median(np.diff(recording.timestamp_s)))
    row_of = {number: row for row, number in enumerate(recording.index.tolist())}
    other = {number: int(recording.index[rows[row]]) for number, row in row_of.items()}
    remark = f"depth is taken from frames {delay_s:.3f} s later, moved along with the picture for the rest"
    confidence = recording.read_confidence
    seen = replace(recording, read_color=functools.lru_cache(READ_AHEAD)(recording.read_color))

    def depth(number: int) -> Float[np.ndarray, "height width"]:
        return known[row_of[number]] * recording.read_depth(other[number])

    def moved(number: int, image: np.ndarray) -> np.ndarray:
        if (motion := _motion(seen, row_of[number], image.shape)) is None:
            return image
        at = cameras.pixel_grid(*image.shape) - 0.5 + newer_s[row_of[number]] * motion[1]
        x, y = (at[..., axis].astype(np.float32) for axis in (0, 1))
        return cv2.remap(image, x, y, cv2.INTER_NEAREST)

    return replace(
        seen,
        read_depth=depth,
        moved=moved,
        read_confidence=None if confidence is None else lambda number: confidence(other[number]),
        remarks=(*recording.remarks, remark),
    )


def _reprojected(recording: Recording, found: DepthEstimate) -> Recording:
    """Let depth and confidence be reprojected from the estimated camera into the color camera."""
    lens = _scaled(np.median(_depth_intrinsics(recording), axis=0), found.focal)
    remark = f"depth is reprojected: {describe(found, ('camera',))}"
    camera = DepthCamera(lens, found.depth_from_color)
    return replace(recording, depth_camera=camera, remarks=(*recording.remarks, remark))


def describe(found: DepthEstimate, parts: Sequence[str] = PARTS) -> str:
    """Say what was estimated, relative to the stated focal length and the color camera."""
    error, said = dict(zip(PARAMETERS, found.error.tolist(), strict=True)), []
    if "camera" in parts:
        x, y = 100 * rigid.inverse(found.depth_from_color)[:2, 3]
        turned = np.degrees(rigid.rotation_angle(np.eye(3), found.depth_from_color[:3, :3]))
        turned_error = np.degrees(max(error[name] for name in ROTATION))
        said += [
            f"the depth camera has {found.focal:.3f} +- {error['focal']:.3f} times the focal length",
            f"is {abs(x):.1f} +- {100 * error['x']:.1f} cm {'right' if x > 0 else 'left'} of the other",
            f"{abs(y):.1f} +- {100 * error['y']:.1f} cm {'below' if y > 0 else 'above'} it",
            f"turned by {turned:.1f} +- {turned_error:.1f} deg" if turned_error else "and parallel",
        ]
    if "delay" in parts:
        late = "late" if found.delay_s > 0 else "early"
        said.append(f"depth is {1000 * abs(found.delay_s):.0f} +- {1000 * error['delay']:.0f} ms {late}")
    return ", ".join(said)


def as_given(found: DepthCalibration) -> dict[str, str]:
    """Return the keys of `given.GivenCalibration`, as TOML, that state what is clear."""
    said, estimate = {}, found.estimate
    if estimate is not None and "camera" in found.clear:
        lens = np.median(_depth_intrinsics(found.recording), axis=0)
        lens = lens if "camera" in found.used else _scaled(lens, estimate.focal)
        said["depth_intrinsics"] = [round(float(each), 2) for each in lens[[0, 1, 0, 1], [0, 1, 2, 2]]]
        said["depth_from_color"] = [round(float(each), 5) for each in estimate.depth_from_color.ravel()]
    if estimate is not None and "delay" in found.clear:
        said["delay_s"] = round(found.applied_s + estimate.delay_s, 3)
    return {key: str(value) for key, value in said.items()}


def _depth_intrinsics(recording: Recording) -> Float[np.ndarray, "frame 3 3"]:
    """Return the stated intrinsics of the depth camera, in pixels of depth as stored."""
    assert recording.intrinsics is not None and recording.depth_size is not None, recording.where
    if recording.depth_camera is not None:
        return np.tile(recording.depth_camera.intrinsics, (len(recording.index), 1, 1))
    return cameras.scale_intrinsics(recording.intrinsics, recording.color_size, recording.depth_size)


def _scaled(intrinsics: Float[np.ndarray, "3 3"], focal: float) -> Float[np.ndarray, "3 3"]:
    return intrinsics * np.array([[focal, 1, 1], [1, focal, 1], [1, 1, 1]])


def _stated(recording: Recording) -> DepthEstimate:
    pose = np.eye(4) if recording.depth_camera is None else recording.depth_camera.depth_from_color
    return DepthEstimate(1.0, pose, 0.0, np.zeros(len(PARAMETERS)))


def _frames(recording: Recording) -> tuple[list[_Sampled], list[_Sampled]]:
    """Read frames for an estimate, and others that may confirm it."""
    chosen = extraction.choose_frames(recording.timestamp_s, RATE_HZ)
    chosen = chosen[chosen < len(recording.index) - 1]
    rows = chosen[evenly(len(chosen), FRAMES, rounded=True)]
    lenses, read = _depth_intrinsics(recording), ([], [])
    size = extraction.reduced_size(recording.color_size, SIDE_PX)
    assert recording.intrinsics is not None
    intrinsics = cameras.scale_intrinsics(recording.intrinsics, recording.color_size, size)
    for number, row in enumerate(rows.tolist()):
        if (motion := _motion(recording, row, size)) is not None:
            gray, none = motion[0], np.zeros((1, 1), np.float32)
            frame = StepFrame(relative_slopes(gray), intrinsics[row], motion[1], none, lenses[row])
            read[number % EVERY == EVERY - 1].append((row, frame))
    return read


def _motion(
    recording: Recording, row: int, size: tuple[int, int]
) -> tuple[UInt8[np.ndarray, "height width"], Float[np.ndarray, "height width 2"]] | None:
    """Return a frame's gray picture and its motion to the next one, pixels per second; None if damaged."""
    other = row + 1 if row + 1 < len(recording.index) else row - 1
    colors = (extraction.picture(recording, each, size) for each in (row, other))
    grays = [cv2.cvtColor(color, cv2.COLOR_RGB2GRAY) for color in colors if color is not None]
    if len(grays) < 2:
        return None
    dense = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    flow = dense.calc(grays[0], grays[1], np.zeros((*size, 2), np.float32))
    return grays[0], flow / np.float32(recording.timestamp_s[other] - recording.timestamp_s[row])


def _profiles(recording: Recording, frames: Sequence[_Sampled], camera: DepthEstimate) -> StepProfiles:
    """Return profiles for the depth that belongs to the frames if the camera is right."""
    times, steps = recording.timestamp_s, []
    for row, frame in frames:
        other = int(nearest(times, times[[row]] + camera.delay_s)[0])
        depth = extraction.known_depth(recording.read_depth(int(recording.index[other])), FARTHEST_M)
        lens = _scaled(frame.depth_intrinsics, camera.focal)
        later_s = float(times[other] - times[row])
        steps.append(replace(frame, depth=depth, depth_intrinsics=lens, later_s=later_s))
    return depth_steps.profiles(steps, rigid.inverse(camera.depth_from_color), camera.delay_s)


def _confirmed(
    recording: Recording, others: Sequence[_Sampled], found: DepthEstimate, parts: Sequence[str]
) -> bool:
    """Return whether outlines of other frames lie on edges significantly more often than as stated."""
    stated = _stated(recording)
    changed = found if "camera" in parts else stated
    changed = replace(changed, delay_s=found.delay_s if "delay" in parts else 0.0)
    steps = [[_profiles(recording, [frame], camera) for frame in others] for camera in (changed, stated)]
    better, before = (np.array([estimation.contrast(each) for each in row]) for row in steps)
    return beats(better, before, tests=1)


def _estimated(recording: Recording, frames: Sequence[_Sampled]) -> DepthEstimate | None:
    """Estimate the camera, turned if that is significant; None where too little is seen."""
    camera, best, start = _stated(recording), -np.inf, None
    stated = camera.depth_from_color
    for delay_s in START_DELAYS_S:
        tried = replace(camera, delay_s=delay_s)
        score, value = estimation.start(_profiles(recording, frames[::EVERY], tried))
        if score > best:
            best, start = score, _moved(tried, value)
    found = None if start is None else _refined(recording, frames, start, PARALLEL)
    if found is None:
        return None
    turned = _refined(recording, frames, found[0], PARAMETERS)
    if turned is not None and _is_turned(stated, *turned):
        found = turned
    estimate, last = found
    covariance = last.covariance[: len(CAMERA), : len(CAMERA)]
    steps = _profiles(recording, frames, replace(estimate, focal=1.0, depth_from_color=stated))
    derivative = steps.derivative[:, : len(CAMERA)]
    moved = derivative @ _difference(stated, estimate)
    errors = np.einsum("pi,ij,pj->p", derivative, covariance, derivative)
    side = max(frames[0][1].slopes.shape)
    shift, shift_error = (float(np.sqrt(np.mean(each)) / side) for each in (moved**2, errors))
    return replace(estimate, shift=shift, shift_error=shift_error)


def _refined(
    recording: Recording, frames: Sequence[_Sampled], camera: DepthEstimate, free: Sequence[str]
) -> tuple[DepthEstimate, ParameterFit] | None:
    """Fit parameters repeatedly, until the camera no longer changes by more than its standard errors."""
    for _ in range(ROUNDS):
        last = estimation.fit(_profiles(recording, frames, camera), free)
        if last is None:
            return None
        camera = replace(_moved(camera, last.value), error=last.error)
        changed = [PARAMETERS.index(name) for name in free if name != "margin"]
        if (np.abs(last.value) <= last.error)[changed].all():
            break
    return camera, last


def _moved(camera: DepthEstimate, value: Float[np.ndarray, "parameter"]) -> DepthEstimate:
    focal, x, y, *turn, delay_s, _ = value.tolist()
    change = rigid.make(rigid.rotation_from_vector(np.array(turn)), np.array([-x, -y, 0.0]))
    depth_from_color = rigid.inverse(change @ rigid.inverse(camera.depth_from_color))
    return replace(
        camera,
        focal=camera.focal * (1 + focal),
        depth_from_color=depth_from_color,
        delay_s=camera.delay_s + delay_s,
    )


def _difference(stated: Float[np.ndarray, "4 4"], found: DepthEstimate) -> Float[np.ndarray, "6"]:
    """Return the camera's parameters relative to the stated one."""
    change = rigid.inverse(found.depth_from_color) @ stated
    turn = rigid.vector_from_rotation(change[:3, :3])
    return np.array([found.focal - 1, *-change[:2, 3], *turn])


def _is_turned(stated: Float[np.ndarray, "4 4"], found: DepthEstimate, last: ParameterFit) -> bool:
    columns = [PARAMETERS.index(name) for name in ROTATION]
    turn = _difference(stated, found)[columns]
    wald = turn @ np.linalg.solve(last.covariance[np.ix_(columns, columns)], turn)
    return bool(wald > SIGMAS**2)
