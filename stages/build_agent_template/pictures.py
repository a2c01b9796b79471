"""Quality page of the template: turntables of color and bones, checks with thresholds."""

import numpy as np
import trimesh
from jaxtyping import Float, UInt8
from matplotlib.colors import hsv_to_rgb

from pipeline.data import plots
from pipeline.data.qa import Check, Picture
from pipeline.geometry import rigid
from pipeline.geometry import views as overview
from pipeline.geometry.meshes import Mesh, RayCaster
from stages.build_agent_template.template import CanonicalTemplate

VIEWS, SIZE_PX = 8, 220
FOCAL, LIFTS_RAD, DISTANCE = 1.4, (0.25, 0.9), 3.2
"""the turntable's focal length in picture widths, elevations, and distance in radii of the mesh"""
SATURATION, VALUES = 0.75, (0.7, 0.95)
"""saturation and value of a bone's color; neighbors alternate in value"""


def turntable(mesh: Mesh) -> UInt8[np.ndarray, "height width 3"]:
    """Draw the mesh (agent frame) all around, starting at the head, one row per elevation."""
    caster, radius = RayCaster(mesh), float(np.linalg.norm(mesh.vertices, axis=1).max())
    focal, up = FOCAL * SIZE_PX, np.array([0.0, 1.0, 0.0])
    intrinsics = np.array([[focal, 0, SIZE_PX / 2], [0, focal, SIZE_PX / 2], [0, 0, 1]])
    shown = []
    for lift in LIFTS_RAD:
        for turn in 2 * np.pi * np.arange(VIEWS) / VIEWS:
            toward = np.array([np.cos(lift) * np.sin(turn), np.sin(lift), np.cos(lift) * np.cos(turn)])
            camera = rigid.look_at(DISTANCE * radius * toward, np.zeros(3), up)
            shown.append(overview.view(caster, camera, intrinsics, SIZE_PX, SIZE_PX))
    return plots.grid(shown, VIEWS)


def bone_colors(weights: Float[np.ndarray, "vertex bone"]) -> UInt8[np.ndarray, "vertex 3"]:
    """Blend one hue per bone by the skinning weights."""
    bone = np.arange(weights.shape[1])
    hue, value = (7 * bone % len(bone)) / len(bone), np.where(bone % 2, VALUES[1], VALUES[0])
    color = hsv_to_rgb(np.stack([hue, np.full(len(bone), SATURATION), value], axis=1))
    return np.round(255 * weights @ color).astype(np.uint8)


def report(template: CanonicalTemplate) -> tuple[list[Check], list[Picture]]:
    """Return the stage's checks and pictures."""
    mesh = template.mesh
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    influence = template.weights.sum(0)
    idle = influence < 0.01 * influence.mean() * len(influence)
    known = template.silhouette_iou[np.isfinite(template.silhouette_iou)]
    # a resting animal fits its masks in nearly all frames, one that turns or walks away does not
    lowest_iou = float(np.quantile(known, 0.1)) if len(known) else None
    checks = [
        Check("circle covered", template.coverage_deg, "deg", warn=330, fail=200, better="higher"),
        Check("agreement of depth pictures", 1000 * template.residual_m, "mm", warn=20),
        Check("silhouette against masks, IoU, lowest tenth", lowest_iou, "", 0.7, 0.5, "higher"),
        Check("surface is closed", float(solid.is_watertight), "", warn=0.5, better="higher"),
        Check("length", float(np.ptp(mesh.vertices[:, 2])), "m"),
        Check("height", float(np.ptp(mesh.vertices[:, 1])), "m"),
        Check("volume", 1000 * float(abs(solid.volume)), "l"),
        Check("longer than wide (1 = ambiguous)", template.elongation, "", warn=1.3, better="higher"),
        Check("head against tail (50 = ambiguous)", 100 * template.head_share, "%", warn=55, better="higher"),
        Check("bones that move less than 1 % of the surface", float(idle.sum()), "", warn=8),
    ]
    bones = Mesh(mesh.vertices, mesh.faces, bone_colors(template.weights))
    pictures = [
        Picture("turntable", turntable(mesh), "the canonical animal, its head's side first"),
        Picture("bones", turntable(bones), "one hue per bone, mixed by the skinning weights"),
    ]
    return checks, pictures
