"""The stage: pictures of a plain video and the map -> frames with cameras and depth, and the quality page."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import assert_never

import cv2
import numpy as np

from pipeline.backends.monocular_depth import MonocularDepth
from pipeline.core import devices
from pipeline.core.errors import InputError
from pipeline.core.progress import log, track
from pipeline.core.videos import Video, role_of_animal
from pipeline.data import ply
from pipeline.data.clips import Clip, Pictures
from pipeline.data.templates import SceneCameras, read_floor
from pipeline.geometry import cameras
from pipeline.geometry.contact import StandingSurface
from pipeline.geometry.meshes import RayCaster
from pipeline.mapping.sift import Keypoints
from pipeline.segmentation.recognizer import load
from stages.estimate_depth import depth, foreground, landmarks, lens, sequence, tracking, views, writing
from stages.estimate_depth.config import Config
from stages.estimate_depth.foreground import ColorView
from stages.estimate_depth.lens import Lens
from stages.estimate_depth.tracking import MapViews, Tracked, TrackingInput

MIN_PLACED, MIN_FRAMES = 0.3, 10
"""Least share and number of frames with a camera pose in the map."""
ENOUGH_PLACED = 0.9
"""Share of frames placed from single ones on, below which the video is placed as a whole as well."""


@dataclass(frozen=True)
class Inputs:
    """What the stage reads."""

    pictures: Path
    """`pictures/<id>` of the recording."""
    frames: Mapping[str, Path]
    """The walk-through of the map, by recording id."""
    scene_template: Path
    """The map."""
    recognizer: Path | None = None
    """The artifact `recognizer`; with it, a session's animal is recognized instead of any foreground."""


def run(
    inputs: Inputs, config: Config, out: Path, *, device: devices.Device = "cpu", video: Video | None = None
) -> writing.Estimated:
    """Estimate cameras and depth of one recording into `out`.

    Raises MAP-007 if the recording does not match the map, MOD-001 to MOD-003 for a checkpoint.
    """
    pictures, walk = Pictures.open(inputs.pictures), Clip.open(next(iter(inputs.frames.values())))
    walk_cameras = SceneCameras.open(inputs.scene_template)
    caster = RayCaster(ply.read_ply(inputs.scene_template / "mesh.ply"))
    network = None if config.backend == "contact" else MonocularDepth(config.backend, config.weights, device)
    known = landmarks.build(walk, walk_cameras, caster)
    keyframes = landmarks.keyframe_numbers(walk_cameras).tolist()
    walk_views = [_walk_view(walk, walk_cameras, frame, caster) for frame in keyframes]
    room = MapViews(caster, [each.view for each in walk_views])
    found, tracked = _placed(pictures, known, room, config)
    placed = np.flatnonzero(tracked.placed)
    if len(placed) < max(MIN_FRAMES, MIN_PLACED * len(pictures)):
        raise _unrecognized(pictures, f"{len(placed)} of {len(pictures)} frames find a place in the map")
    log(f"focal length {found.focal_px:.1f} px; {len(placed)} of {len(pictures)} frames placed")
    shown = []
    for frame in track(placed.tolist(), "rendering the map"):
        color = found.undistorted(pictures.color(frame))
        pose, gray = tracked.world_from_camera[frame], views.small_gray(color)
        shown.append(foreground.color_view(color, views.view_of(gray, tracked.lens.intrinsics, pose, caster)))
    match role_of_animal(video, config.role):
        case "turnaround":
            depths = depth.of_turnaround(shown, room, walk_views)
        case "session":
            time_s = pictures.timestamp_s[placed]
            depth_net = None if network is None else _depth_net(network, pictures, placed, found)
            standing = StandingSurface(caster, read_floor(inputs.scene_template))
            nets = depth_net, None if inputs.recognizer is None else load(inputs.recognizer)
            depths = depth.of_session(shown, time_s, room, walk_views, standing, config.length_m, *nets)
        case role:
            assert_never(role)
    chosen = [number for number, each in enumerate(depths) if each is not None]
    known = [each for each in depths if each is not None]
    if len(chosen) < MIN_FRAMES:
        raise _unrecognized(pictures, "its pictures differ from what the map shows nearly everywhere")
    log(f"{len(placed) - len(chosen)} frames left out that differ from the map nearly everywhere")
    estimated = writing.Estimated(placed[chosen], tracked, found, known)
    writing.write(out, pictures, estimated, config.jpeg_quality)
    writing.report_quality(out, pictures, estimated)
    return estimated


def _walk_view(walk: Clip, walk_cameras: SceneCameras, frame: int, caster: RayCaster) -> ColorView:
    color = walk.color(frame)
    gray = views.small_gray(color)
    intrinsics = cameras.scale_intrinsics(walk.intrinsics[frame], walk.color_size, gray.shape)
    pose = walk_cameras.world_from_camera[frame]
    return foreground.color_view(color, views.view_of(gray, intrinsics, pose, caster))


def _placed(
    pictures: Pictures, known: landmarks.Landmarks, room: MapViews, config: Config
) -> tuple[Lens, Tracked]:
    """Calibrate the lens and estimate the camera poses: by frames, then, if many have none, as a whole."""
    frames = range(len(pictures))
    keypoints = [landmarks.describe(pictures.color(each)) for each in track(frames, "detecting keypoints")]
    matches = [known.match(each) for each in track(keypoints, "matching the map")]

    def tracked(found: Lens, localized: np.ndarray) -> tuple[Lens, Tracked]:
        gray = [views.small_gray(found.undistorted(pictures.color(frame))) for frame in frames]
        scale = gray[0].shape[1] / pictures.color_size[1]
        small = [Keypoints(each.pixel * scale, each.descriptors) for each in keypoints]
        footage = TrackingInput(pictures.timestamp_s, gray, small, found.resized(gray[0].shape))
        placed = tracking.place(footage, localized, room, config.seed)
        return Lens(placed.lens.focal_px / scale, found.radial, pictures.color_size), placed

    found = lens.calibrate(matches, pictures.color_size, config.seed)
    by_frames = None if found is None else tracked(found, lens.locate_all(matches, found, config.seed))
    if by_frames is not None and by_frames[1].placed.mean() >= ENOUGH_PLACED:
        return by_frames
    log("many frames alone find no place in the map; placing the video as a whole")
    bounds = np.quantile(room.caster.mesh.vertices, [0, 1], axis=0)
    whole = sequence.place(pictures, matches, found, bounds, config.seed)
    as_whole = None if whole is None else tracked(*whole)
    results = [each for each in (by_frames, as_whole) if each is not None]
    if not results:
        raise _unrecognized(pictures, "neither single frames nor the whole fit the map in one place")
    return max(results, key=lambda each: each[1].placed.sum())


def _depth_net(
    network: MonocularDepth, pictures: Pictures, placed: np.ndarray, found: Lens
) -> depth.DepthNet:
    def depth_net(number: int, mapped: np.ndarray, counts: np.ndarray) -> np.ndarray:
        color = found.undistorted(pictures.color(int(placed[number])))
        inverse = cv2.resize(network.inverse_depth(color), mapped.shape[::-1], interpolation=cv2.INTER_LINEAR)
        return depth.aligned(inverse, mapped, counts & (mapped > 0))

    return depth_net


def _unrecognized(pictures: Pictures, what: str) -> InputError:
    film = "film it in the room of the walk-through, with furniture in view and little moved since"
    unused = 'leave it out by role = "unused" in its .toml file or the recipe'
    remedy = f"{film}; or record it with depth; or {unused}"
    return InputError("MAP-007", what, str(pictures.folder), remedy)
