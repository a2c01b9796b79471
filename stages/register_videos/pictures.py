"""Quality page, checks and status file of a recording."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.data import plots
from pipeline.data.clips import Clip
from pipeline.data.qa import Check, Picture, captioned
from pipeline.geometry import rigid, views
from pipeline.geometry.meshes import RayCaster, render_view
from pipeline.mapping.picture_agreement import MIN_PAIRS
from pipeline.metrics.intervals import finite
from stages.register_videos.comparison import AnimalSize
from stages.register_videos.registration import Maps, Registered, Rejected

EDGE_RGB, PHONE_RGB, ANIMAL_RGB, HEAD_RGB = (255, 60, 200), (40, 90, 220), (230, 120, 20), (250, 210, 60)
DEPTH_EDGE_M, OUTLINE_STEP = 0.08, 1.0
"""thresholds of drawn edges: of depth, and of the animal's silhouette (any step is larger)"""
HEADING_M = 0.2
"""length of the line that shows where the animal faces"""
STEP_FRAMES, MIN_STEP_M, AHEAD = 5, 0.2, 0.7
"""an animal walks if it moves farther than `MIN_STEP_M` within `STEP_FRAMES`, and ahead if within 45 degrees
(the cosine) of its heading: a template that is turned by 60 degrees does not"""
CAPTIONS = {
    "edges": "Template edges (magenta) and the placed animal (orange) over frames.",
    "bird": "From above: the phone's path (blue), the animal's (orange, yellow towards its head).",
}


def status(
    result: Registered | Rejected, walk_time_s: Float[np.ndarray, "walk"], walk: Float[np.ndarray, "walk 4 4"]
) -> dict:
    """Return the content of ``status.json``, with the nearest view's time in the walk-through."""
    votes = result.votes
    figures = {"frames_localized": votes.queries, "votes": len(votes.frame)}
    nearest = None
    if votes.nearest is not None:
        nearest = {
            "inlier_ratio": votes.nearest.inlier_ratio,
            "walkthrough_s": float(walk_time_s[nearest_frame(walk, votes.nearest.map_from_camera)]),
            "world_from_camera": votes.nearest.map_from_camera.round(6).tolist(),
        }
    if isinstance(result, Rejected):
        return {"registered": False, "reason": result.reason, "nearest_view": nearest, "figures": figures}
    placed = result.agent_confidence[result.roots.visible]
    figures |= {
        "votes_agreeing": int(result.inliers.sum()),
        "depth_gap_m": finite(result.aligned.median_gap_m),
        "depth_fit": finite(result.aligned.median_fit),
        "appearance": result.appearance,
        "confidence": float(result.confidence.mean()),
        "agent_frames": len(placed),
        "agent_confidence": float(placed.mean()) if len(placed) else 0.0,
    }
    return {"registered": True, "reason": None, "nearest_view": nearest, "figures": figures}


def nearest_frame(walk: Float[np.ndarray, "walk 4 4"], world_from_camera: Float[np.ndarray, "4 4"]) -> int:
    """Return the walk-through's frame of the nearest camera: a meter counts as much as a radian."""
    distance_m = np.linalg.norm(walk[:, :3, 3] - world_from_camera[:3, 3], axis=1)
    return int(np.argmin(distance_m + rigid.rotation_angle(walk[:, :3, :3], world_from_camera[:3, :3])))


def checks(result: Registered | Rejected, *, mapped: bool) -> list[Check]:
    """Return the quality checks; ``mapped``: the cameras and the static depth are from the map itself."""
    if isinstance(result, Rejected):
        return [Check("registered", 0.0, "", 0.5, 0.5, "higher")]
    agreeing = float(result.inliers.mean()) if len(result.inliers) else None
    roots = result.roots.world_from_agent
    gap_cm = finite(result.aligned.median_gap_m * 100)
    by_depth = [
        Check("frame votes that agree", agreeing, "share", 0.5, 0.25, "higher"),
        Check("depth against the template", gap_cm, "cm, median", 2.5, 6.0),
        Check("static depth within 5 cm", finite(result.aligned.median_fit), "share", 0.6, 0.35, "higher"),
    ]
    return [
        Check("registered", 1.0, "", 0.5, 0.5, "higher"),
        *([] if mapped else by_depth),
        Check("appearance of frames and renderings", result.appearance, "share", 0.5, None, "higher"),
        Check("camera confidence", float(result.confidence.mean()), "mean probability", 0.6, 0.2, "higher"),
        Check("animal placed", float(result.roots.visible.mean()), "share of frames", 0.4, None, "higher"),
        Check("way walked head first", head_first(roots), "share", 0.5, None, "higher"),
        *_size_checks(result.size),
    ]


def _size_checks(size: AnimalSize | None) -> list[Check]:
    """Return the check of the animal's size, if enough frames show it."""
    if size is None or size.frames < MIN_PAIRS:
        return []
    iou = f"silhouette's IoU {size.iou:.2f}"
    name = f"animal of the template's size ({iou})"
    if size.better is not None:
        better = f"{size.better:g} times the size gives {size.better_iou:.2f}"
        name = f"animal of the template's size ({iou}, {better}: another animal, or other lengths?)"
    return [Check(name, float(size.better is None), "", 0.5, None, "higher")]


def head_first(world_from_agent: Float[np.ndarray, "frame 4 4"]) -> float | None:
    """Return the share of the walked distance on which the animal faced ahead; None if it does not walk.

    Low if the template's head and tail are swapped, or it is turned (`[build_agent_template] turn_deg`).
    """
    step = world_from_agent[STEP_FRAMES:, :3, 3] - world_from_agent[:-STEP_FRAMES, :3, 3]
    step, heading = step[:, [0, 2]], world_from_agent[:-STEP_FRAMES, [0, 2], 2]
    length, level = np.linalg.norm(step, axis=-1), np.linalg.norm(heading, axis=-1)
    walks, ahead = length > MIN_STEP_M, (step * heading).sum(-1) > AHEAD * length * level
    return float(length[walks & ahead].sum() / length[walks].sum()) if walks.any() else None


def pictures(result: Registered | Rejected, clip: Clip, maps: Maps) -> list[Picture]:
    """Draw the pictures of the quality page."""
    if isinstance(result, Rejected):
        return _rejected_pictures(result, clip, maps)
    scene, agent = RayCaster(maps.scene), RayCaster(maps.agent)
    chosen = np.linspace(0, len(clip) - 1, 9).astype(int)[1:-1]
    edges = plots.grid([outlined(result, clip, scene, agent, int(frame)) for frame in chosen], len(chosen))
    return captioned(CAPTIONS, edges=edges, bird=paths(result, maps))


def outlined(
    result: Registered, clip: Clip, scene: RayCaster, agent: RayCaster, frame: int
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw the depth edges of the rendered template and the animal's outline over one frame."""
    height, width = clip.color_size
    camera = result.aligned.world_from_camera[frame]
    picture = clip.color(frame).copy()
    depth, _ = render_view(scene, camera, clip.intrinsics[frame], height, width)
    picture[_edges(depth, DEPTH_EDGE_M)] = EDGE_RGB
    root = result.roots.world_from_agent[frame]
    if np.isfinite(root).all():
        body, _ = render_view(agent, rigid.inverse(root) @ camera, clip.intrinsics[frame], height, width)
        picture[_edges((body > 0).astype(np.float32) * 9, OUTLINE_STEP)] = ANIMAL_RGB
    return picture


def _edges(depth, jump_m):
    window = np.ones((3, 3), np.uint8)
    return cv2.dilate(depth, window) - cv2.erode(depth, window) > jump_m * (1 + depth / 3)


def paths(result: Registered, maps: Maps) -> UInt8[np.ndarray, "height width 3"]:
    """Draw the camera's and the animal's path over the room."""
    picture = views.bird_view(maps.scene, floor_m=maps.floor_m)
    root = result.roots.world_from_agent
    picture.draw(result.aligned.world_from_camera[:, :3, 3], PHONE_RGB)
    picture.draw(root[:, :3, 3], ANIMAL_RGB)
    for frame in np.flatnonzero(result.roots.visible)[::10]:
        middle = root[frame, :3, 3]
        picture.draw(np.stack([middle, middle + HEADING_M * root[frame, :3, 2]]), HEAD_RGB)
    return picture.image


def _rejected_pictures(result, clip, maps):
    frame = len(clip) // 2
    middle = clip.color(frame)
    if result.votes.nearest is None:
        return [Picture("frame", middle, "A frame of the recording; the template has no similar view.")]
    camera, intrinsics = result.votes.nearest.map_from_camera, clip.intrinsics[frame]
    nearest = views.view(RayCaster(maps.scene), camera, intrinsics, *clip.color_size)
    caption = "A frame of the recording, and the nearest view of the template."
    return [Picture("nearest", plots.grid([middle, nearest], 2), caption)]
