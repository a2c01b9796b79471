"""Quality page, checks and status file of a registered recording."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.data import plots
from pipeline.data.clips import Clip
from pipeline.data.qa import Check, Picture, captioned
from pipeline.geometry import rigid, views
from pipeline.geometry.meshes import RayCaster, render_view
from pipeline.mapping.depth_scans import SurfaceMap
from stages.register_videos.registration import Maps, Registered, Rejected

EDGE, PHONE, ANIMAL, HEAD = (255, 60, 200), (40, 90, 220), (230, 120, 20), (250, 210, 60)
FAR, CLOSE = (210, 50, 40), (50, 170, 80)
"""colors of poses further from the others than `SAME_M`, and of poses as near"""
SAME_M = 0.05
DEPTH_EDGE_M, OUTLINE = 0.08, 1.0
"""steps that are drawn as edges: of depth, and of the animal's silhouette (any step is larger)"""
HEADING_M = 0.2
"""length of the line that shows where the animal faces"""
WALK_FRAMES, WALK_M = 5, 0.2
"""an animal walks that goes further than this in so many frames"""
CAPTIONS = {
    "edges": "Template edges (magenta) and the placed animal (orange) over frames.",
    "bird": "From above: the phone's path (blue), the animal's (orange, yellow towards its head).",
    "depth": "Static depth on the map from above: green within 5 cm of the surface, red further away.",
}


def status(
    result: Registered | Rejected, walk_time_s: Float[np.ndarray, "walk"], walk: Float[np.ndarray, "walk 4 4"]
) -> dict:
    """Describe the outcome for ``status.json``; the nearest view is also given as a moment of the
    walk-through."""
    votes = result.votes
    figures = {"frames_localized": votes.asked, "votes": len(votes.frame)}
    if votes.nearest is None:
        nearest = None
    else:
        nearest = {
            "inlier_ratio": votes.nearest.inlier_ratio,
            "walkthrough_s": float(walk_time_s[nearest_frame(walk, votes.nearest.map_from_camera)]),
            "world_from_camera": votes.nearest.map_from_camera.round(6).tolist(),
        }
    if isinstance(result, Rejected):
        return {"registered": False, "reason": result.reason, "nearest_view": nearest, "figures": figures}
    figures |= {
        "votes_agreeing": int(result.supports.sum()),
        "depth_gap_m": _finite(result.aligned.median_gap_m),
        "depth_fit": _finite(result.aligned.median_fit),
        "appearance": result.appearance,
        "confidence": float(result.confidence.mean()),
        "agent_frames": int(result.roots.visible.sum()),
        "agent_confidence": float(result.agent_confidence[result.roots.visible].mean())
        if result.roots.visible.any()
        else 0.0,
    }
    return {"registered": True, "reason": None, "nearest_view": nearest, "figures": figures}


def _finite(figure):
    """Return a figure for JSON: null where nothing was measured."""
    return figure if np.isfinite(figure) else None


def nearest_frame(walk: Float[np.ndarray, "walk 4 4"], world_from_camera: Float[np.ndarray, "4 4"]) -> int:
    """Return the frame of the walk-through that was taken most nearly from there: a metre counts as much as a
    radian."""
    away = np.linalg.norm(walk[:, :3, 3] - world_from_camera[:3, 3], axis=1)
    return int(np.argmin(away + rigid.rotation_angle(walk[:, :3, :3], world_from_camera[:3, :3])))


def checks(result: Registered | Rejected) -> list[Check]:
    """Judge the outcome."""
    if isinstance(result, Rejected):
        return [Check("registered", 0.0, "", 0.5, 0.5, "higher")]
    agreed = float(result.supports.mean()) if len(result.supports) else None
    roots = result.roots.world_from_agent
    gap_cm = _finite(result.aligned.median_gap_m * 100)
    return [
        Check("registered", 1.0, "", 0.5, 0.5, "higher"),
        Check("frame votes that agree", agreed, "share", 0.5, 0.25, "higher"),
        Check("depth against the template", gap_cm, "cm, median", 2.5, 6.0),
        Check("static depth within 5 cm", _finite(result.aligned.median_fit), "share", 0.6, 0.35, "higher"),
        Check("appearance of frames and renderings", result.appearance, "share", 0.5, None, "higher"),
        Check("camera confidence", float(result.confidence.mean()), "mean probability", 0.6, 0.2, "higher"),
        Check("animal placed", float(result.roots.visible.mean()), "share of frames", 0.4, None, "higher"),
        Check("way walked head first", head_first(roots), "share", 0.5, None, "higher"),
    ]


def head_first(world_from_agent: Float[np.ndarray, "frame 4 4"]) -> float | None:
    """Return the share of the animal's way on which it faced ahead; None where it does not walk.

    Little where the template's head is the tail (`[build_agent_template] turn_deg`).
    """
    step = world_from_agent[WALK_FRAMES:, :3, 3] - world_from_agent[:-WALK_FRAMES, :3, 3]
    ahead = (step * world_from_agent[:-WALK_FRAMES, :3, 2])[:, [0, 2]].sum(-1)
    length = np.linalg.norm(step[:, [0, 2]], axis=-1)
    walks = length > WALK_M
    return float(length[walks & (ahead > 0)].sum() / length[walks].sum()) if walks.any() else None


def pictures(result: Registered | Rejected, clip: Clip, maps: Maps) -> list[Picture]:
    """Draw the outcome for people."""
    if isinstance(result, Rejected):
        return _refused(result, clip, maps)
    scene, agent = RayCaster(maps.scene), RayCaster(maps.agent)
    chosen = np.linspace(0, len(clip) - 1, 9).astype(int)[1:-1]
    edges = plots.grid([outlined(result, clip, scene, agent, int(frame)) for frame in chosen], len(chosen))
    return captioned(CAPTIONS, edges=edges, bird=paths(result, maps), depth=depth_on_map(result, maps))


def outlined(
    result: Registered, clip: Clip, scene: RayCaster, agent: RayCaster, frame: int
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw the depth edges of the rendered template and the animal's outline over one frame."""
    height, width = clip.color_size
    camera = result.aligned.world_from_camera[frame]
    picture = clip.color(frame).copy()
    depth, _ = render_view(scene, camera, clip.intrinsics[frame], height, width)
    picture[_edges(depth, DEPTH_EDGE_M)] = EDGE
    root = result.roots.world_from_agent[frame]
    if np.isfinite(root).all():
        body, _ = render_view(agent, rigid.inverse(root) @ camera, clip.intrinsics[frame], height, width)
        picture[_edges((body > 0).astype(np.float32) * 9, OUTLINE)] = ANIMAL
    return picture


def _edges(depth, jump_m):
    window = np.ones((3, 3), np.uint8)
    return cv2.dilate(depth, window) - cv2.erode(depth, window) > jump_m * (1 + depth / 3)


def paths(result: Registered, maps: Maps) -> UInt8[np.ndarray, "height width 3"]:
    """Draw both paths over the room."""
    picture = views.bird_view(maps.scene, floor_m=maps.floor_m)
    root = result.roots.world_from_agent
    picture.draw(result.aligned.world_from_camera[:, :3, 3], PHONE)
    picture.draw(root[:, :3, 3], ANIMAL)
    for frame in np.flatnonzero(result.roots.visible)[::10]:
        picture.draw(
            np.stack([root[frame, :3, 3], root[frame, :3, 3] + HEADING_M * root[frame, :3, 2]]), HEAD
        )
    return picture.image


def depth_on_map(result: Registered, maps: Maps) -> UInt8[np.ndarray, "height width 3"]:
    """Draw the static depth of some frames over the room, coloured by its distance from the surface."""
    picture = views.bird_view(maps.scene, floor_m=maps.floor_m)
    surface = SurfaceMap(maps.scene)
    for frame in range(0, len(result.aligned.scans), 10):
        points = rigid.apply(
            result.aligned.world_from_camera[frame], result.aligned.scans[frame].points_camera[::3]
        )
        distance = np.abs(surface.distance(points))
        for pixel, far in zip(np.round(picture.pixel(points)).astype(int), distance, strict=True):
            cv2.circle(
                picture.image, tuple(int(value) for value in pixel), 1, FAR if far > SAME_M else CLOSE, -1
            )
    return picture.image


def _refused(result, clip, maps):
    middle = clip.color(len(clip) // 2)
    if result.votes.nearest is None:
        return [Picture("frame", middle, "A frame of the recording; no view of the template is like it.")]
    frame = len(clip) // 2
    near = views.view(
        RayCaster(maps.scene), result.votes.nearest.map_from_camera, clip.intrinsics[frame], *clip.color_size
    )
    return [
        Picture(
            "nearest",
            plots.grid([middle, near], 2),
            "A frame of the recording, and the nearest view of the template.",
        )
    ]
