"""From a recording to upright frames at a fixed rate.

`understand` takes a second and reads a dozen depth pictures; `frames` then reads one picture at a time.
"""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.core.errors import InputError
from pipeline.data import images
from pipeline.geometry import align, cameras, rigid
from pipeline.geometry.subsampling import evenly
from pipeline.mapping import picture_agreement
from pipeline.mapping.picture_agreement import CLOCKS, PictureAgreement, PosedPicture
from pipeline.recordings import conventions, errors, upright
from pipeline.recordings.conventions import PoseCheck
from pipeline.recordings.recording import Picture, Recording, grid_size

JPEG = b"\xff\xd8"
MAX_DEPTH_SIDE_PX = 640
"""larger depth was upsampled by the app; it is downsampled again"""
MIN_FRAMES = 5
"""minimum number of extracted frames: half a second"""
MIN_TRACKED = 0.8
"""minimum share of frames with a device pose for poses to be used at all"""
MEASURED, RELATIVE = "measured", "relative"
UPRIGHT_VIEWS = 12
"""number of frames whose depth is used to find the up direction if no sensor measured it"""
MAX_TILT_DEG = 45.0
"""angle between a device's up and the room's beyond which another axis points up"""
UNIT_VIEWS = 5
"""number of frames for checking the unit of depth"""
NEAREST_TYPICAL_M, FARTHEST_TYPICAL = 0.1, 2.0
"""limits of the median depth: meters, and multiples of the maximum depth that is used"""
MAX_STRETCHED, MAX_OFF_CENTER = 0.03, 0.15
"""maximum relative differences: of aspect ratios of pictures and depth, of principal point and middle"""
AGREEMENT_PAIRS, AGREEMENT_GAP_S = 40, 1.2
"""pairs of pictures whose agreement is checked, and seconds between the two"""
SHARPNESS_WIDTH_PX = 240
DARK, BLURRED_SHARE = 0.15, 0.4
"""a picture is dark below this mean brightness (0..1), blurred below this share of the median sharpness"""


@dataclass(frozen=True)
class ExtractionPlan:
    """How to extract a recording; ``chosen`` indexes its frames, everything else is upright."""

    chosen: Int[np.ndarray, "frame"]
    timestamp_s: Float[np.ndarray, "frame"]
    stored_size: tuple[int, int]
    """(height, width) of the color pictures before rotation"""
    intrinsics: Float[np.ndarray, "frame 3 3"]
    """color pixels"""
    depth_intrinsics: Float[np.ndarray, "frame 3 3"]
    odometry_from_camera: Float[np.ndarray, "frame 4 4"] | None
    gravity_known: bool
    quarter_turns: int
    """clockwise, stored to upright"""
    pose_check: PoseCheck
    scale: str = MEASURED
    """`measured` by its own depth, `relative`, or the id of the recording that supplied it"""


@dataclass(frozen=True)
class ExtractedFrame:
    """One upright frame."""

    color: UInt8[np.ndarray, "height width 3"]
    jpeg: bytes | None
    """the phone's original bytes if the picture is unchanged"""
    depth: Float[np.ndarray, "depth_height depth_width"]
    """meters, 0 = unknown"""
    confidence: UInt8[np.ndarray, "depth_height depth_width"]
    """0 low, 1 medium, 2 high"""
    sharpness: float
    """standard deviation of the Laplacian at a common width"""
    brightness: float
    """mean, 0..1"""
    depth_valid: float
    """share of known depth"""


def understand(
    recording: Recording, *, rate_hz: float, max_depth_m: float, max_side_px: int
) -> ExtractionPlan:
    """Choose frames, check the poses against depth, find the rotation to upright and the picture size.

    Raises CAP-006 for a recording without depth, CAP-004 and CAP-008 for impossible intrinsics and depth.
    """
    if recording.depth_size is None or recording.intrinsics is None:
        why = f"{recording.kind}; an animal moves, so its distance cannot be triangulated from pictures"
        raise errors.no_depth(recording.where, why)
    _refuse_other_pictures(recording.intrinsics, recording.color_size, recording.where)
    if recording.depth_camera is None:
        _refuse_other_shape(recording.color_size, recording.depth_size, recording.where)
    _refuse_other_unit(recording, max_depth_m)
    depth_size = recording.depth_size
    if recording.depth_camera is not None:
        depth_size = grid_size(depth_size, recording.color_size)
    depth_size = reduced_size(depth_size, MAX_DEPTH_SIDE_PX)
    depth_intrinsics = cameras.scale_intrinsics(recording.intrinsics, recording.color_size, depth_size)
    used, pose, lost = _tracked(recording)

    def view(frame: int) -> conventions.DepthPicture:
        number = int(recording.index[frame])
        return conventions.DepthPicture(stored_depth(recording, number, max_depth_m), depth_intrinsics[frame])

    check = conventions.check_poses(
        pose, recording.timestamp_s[used], lambda i: view(used[i]), documented=recording.convention
    )
    if pose is None or check.verdict == "unusable":
        used = np.arange(len(recording.index))
        pose, check = None, dataclasses.replace(check, reason="; ".join(filter(None, (check.reason, lost))))
    selected = choose_frames(recording.timestamp_s[used], rate_hz)
    chosen = used[selected]
    pose = None if pose is None else pose[selected]
    odometry_from_camera, turns, gravity_known = _upright(recording, pose, check, chosen, view)
    if odometry_from_camera is not None and recording.up is not None and not gravity_known:
        contradicted = f"{check.reason}; but the floor is not level in their world: gravity is not used"
        check = dataclasses.replace(check, reason=contradicted)
    size = reduced_size(recording.color_size, max_side_px)
    intrinsics = cameras.scale_intrinsics(recording.intrinsics, recording.color_size, size)
    return ExtractionPlan(
        chosen=chosen,
        timestamp_s=recording.timestamp_s[chosen],
        stored_size=size,
        intrinsics=cameras.turn_intrinsics(intrinsics, size, turns)[chosen],
        depth_intrinsics=cameras.turn_intrinsics(depth_intrinsics, depth_size, turns)[chosen],
        odometry_from_camera=odometry_from_camera,
        gravity_known=gravity_known,
        quarter_turns=turns,
        pose_check=check,
    )


def _upright(
    recording: Recording,
    pose: Float[np.ndarray, "frame 7"] | None,
    check: PoseCheck,
    chosen: Int[np.ndarray, "frame"],
    view: Callable[[int], conventions.DepthPicture],
) -> tuple[Float[np.ndarray, "frame 4 4"] | None, int, bool]:
    """Return the upright cameras of the chosen frames (None without usable poses), the quarter turns, and
    whether gravity is known: an up direction that the room's floor contradicts is not used.
    """

    def room() -> list[tuple[Float[np.ndarray, "height width"], Float[np.ndarray, "3 3"]]]:
        shown = chosen[evenly(len(chosen), UPRIGHT_VIEWS, rounded=True)]
        return [(each.depth, each.intrinsics) for each in map(view, shown)]

    turns = recording.quarter_turns
    if pose is None:
        return None, turns or upright.quarter_turns_from_surfaces(room()), False
    odometry_from_camera = conventions.odometry_from_pose(pose, check.convention)
    if recording.up is not None:
        turned = align.rotation_between(np.array(recording.up), np.array([0.0, 1.0, 0.0]))
        odometry_from_camera = rigid.make(turned, np.zeros(3)) @ odometry_from_camera
        up = upright.up_from_room(odometry_from_camera, room())
        if up is not None and up[1] < np.cos(np.radians(MAX_TILT_DEG)):
            turns = upright.quarter_turns_from_gravity(odometry_from_camera, up_odometry=up)
            return cameras.turn_camera(odometry_from_camera, turns), turns, False
        turns = upright.quarter_turns_from_gravity(odometry_from_camera)
    elif not turns:
        turns = upright.quarter_turns_from_room(odometry_from_camera, room())
    return cameras.turn_camera(odometry_from_camera, turns), turns, recording.up is not None


def _refuse_other_pictures(
    intrinsics: Float[np.ndarray, "frame 3 3"], color_size: tuple[int, int], where: str
) -> None:
    """Raise CAP-004 for a principal point off the middle: intrinsics of another size or rotation."""
    (height, width), (x, y) = color_size, np.median(intrinsics[:, :2, 2], axis=0)
    if max(abs(x / width - 0.5), abs(y / height - 0.5)) > MAX_OFF_CENTER:
        why = f"the intrinsics' center, {x:.0f} {y:.0f}, is off that of pictures of {width} x {height}"
        raise errors.broken_metadata(where, why)


def _refuse_other_shape(color_size: tuple[int, int], depth_size: tuple[int, int], where: str) -> None:
    """Raise CAP-008 for depth of another aspect ratio than the pictures, both as stored."""
    (height, width), (depth_height, depth_width) = color_size, depth_size
    stretched_px = abs(depth_height - depth_width * height / width)
    rounding_px = 0.5 * (1 + height / width)
    if stretched_px > max(MAX_STRETCHED * depth_height, rounding_px):
        sizes = f"depth of {depth_width} x {depth_height}", f"pictures of {width} x {height}"
        remedy = "crop the one to what the other shows, turned as the pictures are stored"
        raise InputError("CAP-008", " cannot show the same as ".join(sizes), where, remedy)


def _refuse_other_unit(recording: Recording, max_depth_m: float) -> None:
    """Raise CAP-008 for implausibly far or near depth, as if stored in another unit."""
    shown = recording.index[evenly(len(recording.index), UNIT_VIEWS)]
    depth = np.concatenate([recording.read_depth(int(number)).ravel() for number in shown])
    depth = depth[np.isfinite(depth) & (depth > 0)]
    if not len(depth):
        remedy = "record with the LiDAR camera, in light; export it again"
        raise InputError("CAP-007", "every depth picture is empty", recording.where, remedy)
    typical_m = float(np.median(depth))
    if not NEAREST_TYPICAL_M < typical_m < FARTHEST_TYPICAL * max_depth_m:
        what = f"depth is typically {typical_m:.3g} m, where up to {max_depth_m:g} m are used"
        remedy = "PNG holds millimeters (TUM: see depth_scale.txt), EXR meters; record within 5 m"
        raise InputError("CAP-008", what, recording.where, remedy)


def _tracked(recording: Recording) -> tuple[Int[np.ndarray, "used"], Float[np.ndarray, "used 7"] | None, str]:
    """Return the frames to use, their poses, and remarks; without poses if too many are lost."""
    everything = np.arange(len(recording.index))
    if recording.pose is None:
        return everything, None, ""
    known = np.isfinite(recording.pose).all(1) & recording.pose[:, :4].any(1)
    lost = "" if known.all() else f"{100 * (1 - known.mean()):.0f} % of the frames have no device pose"
    used = known if known.mean() >= MIN_TRACKED else np.ones_like(known)
    return everything[used], recording.pose[used], lost


def picture(
    recording: Recording, row: int, size: tuple[int, int] | None = None
) -> UInt8[np.ndarray, "height width 3"] | None:
    """Read one frame's picture as stored, reduced to a (height, width); None if it is damaged."""
    stored = recording.read_color(int(recording.index[row]))
    if stored is None:
        return None
    color = images.decode_color(stored, recording.where) if isinstance(stored, bytes) else stored
    size = size or color.shape[:2]
    return color if color.shape[:2] == size else cv2.resize(color, size[::-1], interpolation=cv2.INTER_AREA)


def frames(
    recording: Recording, plan: ExtractionPlan, *, max_depth_m: float
) -> Iterator[ExtractedFrame | None]:
    """Yield the plan's frames in order, upright; None for damaged ones."""
    for number in recording.index[plan.chosen]:
        stored = recording.read_color(int(number))
        if stored is None:
            yield None
            continue
        color = _decoded(stored, recording.color_size, f"{recording.where}, frame {number}")
        depth = stored_depth(recording, int(number), max_depth_m)
        confidence = confidence_of(recording, int(number), depth)
        if color.shape[:2] != plan.stored_size:
            color = cv2.resize(color, plan.stored_size[::-1], interpolation=cv2.INTER_AREA)
        if plan.quarter_turns:
            turned = (cameras.turn_image(image, plan.quarter_turns) for image in (color, depth, confidence))
            color, depth, confidence = turned
        as_stored = not plan.quarter_turns and plan.stored_size == recording.color_size
        jpeg = stored if as_stored and isinstance(stored, bytes) and stored[:2] == JPEG else None
        sharpness, brightness = picture_statistics(color)
        yield ExtractedFrame(color, jpeg, depth, confidence, sharpness, brightness, float((depth > 0).mean()))


def picture_agreement_of(
    recording: Recording, plan: ExtractionPlan, *, max_depth_m: float
) -> PictureAgreement:
    """Check a recording's pictures against its depth, intrinsics and poses; without poses it is untested."""
    if plan.odometry_from_camera is None:
        return picture_agreement.check([], 0.0)
    pairs = conventions.moving_pairs(
        plan.odometry_from_camera, plan.timestamp_s, AGREEMENT_PAIRS, AGREEMENT_GAP_S
    )
    around = (pairs >= -min(CLOCKS)) & (pairs < len(plan.chosen) - max(CLOCKS))
    pairs = pairs[around.all(1)]
    views = {row: _posed_picture(recording, plan, row, max_depth_m) for row in np.unique(pairs).tolist()}
    shown = [(views[first], views[second]) for first, second in pairs.tolist()]
    step_s = float(np.median(np.diff(plan.timestamp_s))) if len(plan.chosen) > 1 else 0.0
    return picture_agreement.check([(a, b) for a, b in shown if a is not None and b is not None], step_s)


def _posed_picture(
    recording: Recording, plan: ExtractionPlan, row: int, max_depth_m: float
) -> PosedPicture | None:
    """Read one of the plan's frames and the depth around it, upright; None if its picture is damaged."""
    color = picture(recording, int(plan.chosen[row]), plan.stored_size)
    if color is None or plan.odometry_from_camera is None:
        return None
    rows = {step: row + step for step in (0, *CLOCKS)}
    numbers = {step: int(recording.index[plan.chosen[other]]) for step, other in rows.items()}
    depth = {step: stored_depth(recording, number, max_depth_m) for step, number in numbers.items()}
    return PosedPicture(
        cv2.cvtColor(cameras.turn_image(color, plan.quarter_turns), cv2.COLOR_RGB2GRAY),
        plan.intrinsics[row],
        {step: cameras.turn_image(each, plan.quarter_turns) for step, each in depth.items()},
        plan.depth_intrinsics[row],
        {clock: plan.odometry_from_camera[other] for clock, other in rows.items()},
    )


def stored_depth(recording: Recording, number: int, max_depth_m: float) -> Float[np.ndarray, "height width"]:
    """Read one frame's depth in meters, as stored (not rotated), at most `MAX_DEPTH_SIDE_PX` large."""
    depth = known_depth(recording.read_depth(number), max_depth_m)
    depth = known_depth(recording.reprojected(number, depth), max_depth_m)
    depth = _sampled(depth, reduced_size(depth.shape, MAX_DEPTH_SIDE_PX))
    return depth if recording.moved is None else recording.moved(number, depth)


def _sampled(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resize a picture to a (height, width) by nearest neighbor."""
    same = image.shape == size
    return image if same else cv2.resize(image, size[::-1], interpolation=cv2.INTER_NEAREST_EXACT)


def _decoded(stored: Picture, size: tuple[int, int], where: str) -> UInt8[np.ndarray, "height width 3"]:
    color = images.decode_color(stored, where) if isinstance(stored, bytes) else stored
    if color.shape[:2] != size:
        declared = f"the recording declares {size[1]} x {size[0]}"
        raise errors.broken_metadata(where, f"the picture is {color.shape[1]} x {color.shape[0]}, {declared}")
    return color


def confidence_of(
    recording: Recording, number: int, depth: Float[np.ndarray, "height width"]
) -> UInt8[np.ndarray, "height width"]:
    """Return the confidence, 0 to 2, of `stored_depth`: 2 if the recording has none, 0 if it lacks here."""
    if recording.read_confidence is None:
        return np.where(depth > 0, 2, 0).astype(np.uint8)
    confidence = recording.read_confidence(number)
    if confidence is None:
        return np.zeros(depth.shape, np.uint8)
    if recording.depth_camera is not None:  # that of the surface which is nearest in each pixel
        known = known_depth(recording.read_depth(number), np.inf)
        confidence = _sampled(confidence, known.shape)
        seen = [recording.reprojected(number, np.where(confidence >= level, known, 0)) for level in range(3)]
        confidence = np.sum([(seen[0] > 0) & (seen[0] == each) for each in seen[1:]], axis=0, dtype=np.uint8)
    confidence = _sampled(np.minimum(confidence, 2), depth.shape)
    return confidence if recording.moved is None else recording.moved(number, confidence)


def reduced_size(size: tuple[int, int], max_side_px: int) -> tuple[int, int]:
    """Divide a (height, width) by the smallest integer such that its longer side fits ``max_side_px``."""
    factor = -(-max(size) // max_side_px)
    return (round(size[0] / factor), round(size[1] / factor))


def known_depth(
    depth: Float[np.ndarray, "height width"], max_depth_m: float
) -> Float[np.ndarray, "height width"]:
    """Return depth in meters, 0 where it is not finite, not positive or out of the sensor's range."""
    return np.where(np.isfinite(depth) & (depth > 0) & (depth < max_depth_m), depth, np.float32(0))


def picture_statistics(color: UInt8[np.ndarray, "height width 3"]) -> tuple[float, float]:
    """Return (sharpness, brightness 0..1) of a picture; sharpness is measured at a common width."""
    gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    scale = SHARPNESS_WIDTH_PX / gray.shape[1]
    small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else gray
    return float(cv2.Laplacian(small, cv2.CV_32F).std()), float(gray.mean() / 255)


def quality_of(
    sharpness: Float[np.ndarray, "frame"],
    brightness: Float[np.ndarray, "frame"],
    depth_valid: Float[np.ndarray, "frame"],
) -> Float[np.ndarray, "frame"]:
    """Return a quality 0..1 per frame from relative sharpness, brightness and share of known depth."""
    sharp = np.minimum(sharpness / max(float(np.median(sharpness)), 1e-6), 1)
    return sharp * np.minimum(brightness / DARK, 1) * depth_valid


def summary(recording: Recording, plan: ExtractionPlan) -> str:
    """Summarize an extraction plan in one line."""
    seconds = recording.timestamp_s[-1] - recording.timestamp_s[0]
    height, width = recording.color_size
    turned = f"turned {90 * plan.quarter_turns} deg clockwise" if plan.quarter_turns else "upright as stored"
    count, chosen = len(recording.index), len(plan.chosen)
    seen = f"{seconds:.1f} s, {count} frames {width} x {height}, {chosen} kept, {turned}"
    check = plan.pose_check
    measured = f" ({1000 * check.residual_m:.1f} mm)" if np.isfinite(check.residual_m) else ""
    return f"{recording.where}: {recording.kind}, {seen}; {check.reason}{measured}"


def choose_frames(timestamp_s: Float[np.ndarray, "frame"], rate_hz: float) -> Int[np.ndarray, "chosen"]:
    """Pick the frame nearest to every tick of a clock at ``rate_hz``, within half a tick, if any.

    Ticks start at the first frame; ``timestamp_s`` must increase.
    """
    tick = np.rint((timestamp_s - timestamp_s[0]) * rate_hz).astype(int)
    distance_s = np.abs(timestamp_s - timestamp_s[0] - tick / rate_hz)
    order = np.lexsort((distance_s, tick))
    first_of_tick = np.unique(tick[order], return_index=True)[1]
    return order[first_of_tick]
