"""Quality page of the scene template: turntable, bird's-eye coverage, recorded and rendered frames."""

from dataclasses import replace

import numpy as np
from jaxtyping import UInt8

from pipeline.data import plots
from pipeline.data.clips import Clip
from pipeline.data.qa import Check, Picture, captioned
from pipeline.geometry import rigid
from pipeline.geometry import views as overview
from pipeline.geometry.meshes import Mesh, RayCaster
from stages.build_scene_template.template import SceneTemplate

UP = np.array([0.0, 1.0, 0.0])
FOCAL_PX, HEIGHT_PX, WIDTH_PX = 300.0, 240, 320
"""of the turntable's pictures"""
EXTENT, REACH = (0.01, 0.99), 0.95
"""vertex quantiles that bound the shown extent, and the turntable's radius in diagonals of it"""
EYE_OFFSET, EYE_HEIGHT = 0.75, 0.65
"""offset of the turntable's camera, in its radii"""
PATH_COLOR = (220, 40, 40)
CAPTIONS = {
    "turntable": "The fused mesh from four sides, seen through its walls' backs.",
    "coverage": "From above: the seen surface and the walk-through's path.",
    "frames": "Upper row: frames of the walk-through; lower row: the mesh from the same cameras.",
}


def pictures(template: SceneTemplate, clip: Clip) -> list[Picture]:
    """Draw the pictures of the quality page."""
    caster = RayCaster(template.mesh)
    turned, compared = turntable(template.mesh), frames(template, clip, caster)
    return captioned(CAPTIONS, turntable=turned, coverage=coverage(template), frames=compared)


def turntable(mesh: Mesh) -> UInt8[np.ndarray, "height width 3"]:
    """Render a mesh's front faces from four elevated viewpoints."""
    low, high = np.quantile(mesh.vertices, EXTENT, axis=0)
    center, reach = (low + high) / 2, np.linalg.norm(high - low) * REACH
    intrinsics = np.array([[FOCAL_PX, 0, WIDTH_PX // 2], [0, FOCAL_PX, HEIGHT_PX // 2], [0, 0, 1]])
    views = []
    for angle in np.pi * (np.arange(4) / 2 + 0.25):
        eye = center + reach * np.array([np.cos(angle) * EYE_OFFSET, EYE_HEIGHT, np.sin(angle) * EYE_OFFSET])
        facing = (mesh.face_normals() * (eye - mesh.vertices[mesh.faces[:, 0]])).sum(1) > 0
        caster = RayCaster(replace(mesh, faces=mesh.faces[facing]))
        views.append(overview.view(caster, rigid.look_at(eye, center, UP), intrinsics, HEIGHT_PX, WIDTH_PX))
    return plots.grid(views, 2)


def coverage(template: SceneTemplate) -> UInt8[np.ndarray, "height width 3"]:
    """Draw the walk-through's path over a bird's-eye view."""
    picture = overview.bird_view(template.mesh, floor_m=template.floor_m)
    picture.draw(template.world_from_camera[:, :3, 3], PATH_COLOR)
    return picture.image


def frames(template: SceneTemplate, clip: Clip, caster: RayCaster) -> UInt8[np.ndarray, "height width 3"]:
    """Draw frames above the mesh rendered from their cameras."""
    chosen = np.linspace(0, len(clip) - 1, 7).astype(int)[1:-1]
    height, width = clip.color_size
    rendered = [
        overview.view(caster, template.world_from_camera[frame], clip.intrinsics[frame], height, width)
        for frame in chosen
    ]
    return plots.grid([clip.color(int(frame)) for frame in chosen] + rendered, len(chosen))


def checks(template: SceneTemplate) -> list[Check]:
    """Return the quality checks."""
    start = template.start
    surface = [
        Check("meters known", float(template.scale != "relative"), "", 0.5, better="higher"),
        Check("depth against the surface", float(np.nanmedian(template.gap_m) * 100), "cm, median", 2.0, 5.0),
        Check("frames that fit the surface", float(template.registered.mean()), "share", 0.95, 0.5, "higher"),
    ]
    if template.own_mesh:
        return surface
    registered = len(start.registered) / int(template.keyframe.sum())
    odometry = None if template.odometry_scale is None else abs(template.odometry_scale - 1)
    return [
        Check("keyframes registered by COLMAP", registered, "share", 0.8, 0.0, "higher"),
        Check("reprojection error", template.reprojection_px, "px", 1.5),
        Check("scale against depth, relative spread", start.scale_deviation, "", 0.05),
        Check("scale of map against odometry; either may be off", odometry, "relative difference", 0.05),
        *surface,
    ]


def _scale(template: SceneTemplate) -> str:
    """Return the source of metric scale, in words."""
    if template.scale == "relative":
        return "relative: from pictures alone, lengths are no meters"
    if template.scale != "measured":
        return f"pictures alone, meters from the depth of {template.scale}"
    return "depth under COLMAP's tracks" if template.start.source == "colmap" else "odometry and depth"


def world(template: SceneTemplate) -> dict:
    """Return ``world.json``: the world frame and how it was determined."""
    start = template.start
    low, high = template.mesh.vertices.min(0), template.mesh.vertices.max(0)
    return {
        "up": [0.0, 1.0, 0.0],
        "gravity": template.gravity,
        "scale": _scale(template),
        "poses": start.source,
        "mesh": "the recording's own" if template.own_mesh else "fused from depth",
        "colmap_refuted": start.reason or None,
        "bounds": [low.round(4).tolist(), high.round(4).tolist()],
        "floor": round(template.floor_m, 4),
        "keyframes": int(template.keyframe.sum()),
        "keyframes_registered": len(start.registered),
        "reprojection_px": template.reprojection_px,
        "scale_spread": start.scale_deviation,
        "scale_against_odometry": template.odometry_scale,
        "depth_gap_m": start.gap_m,
        "surface_gap_m": float(np.nanmedian(template.gap_m)),
    }
