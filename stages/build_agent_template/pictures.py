"""What the report shows of the template: turntables of color and bones, figures with thresholds."""

import colorsys

import numpy as np
import trimesh
from jaxtyping import Float, UInt8

from pipeline.data.qa import Check, Picture
from pipeline.geometry import rigid
from pipeline.geometry import views as overview
from pipeline.geometry.meshes import Mesh, RayCaster
from stages.build_agent_template.template import CanonicalTemplate


def turntable(mesh: Mesh, views: int = 8, size_px: int = 220) -> UInt8[np.ndarray, "height width 3"]:
    """Draw the mesh (agent frame) from around, the head's side first; the rows look from the side and from
    above.
    """
    caster, radius = RayCaster(mesh), float(np.linalg.norm(mesh.vertices, axis=1).max())
    focal = 1.4 * size_px
    intrinsics = np.array([[focal, 0, size_px / 2], [0, focal, size_px / 2], [0, 0, 1]])
    rows = []
    for lift in (0.25, 0.9):
        row = []
        for index in range(views):
            turn = 2 * np.pi * index / views
            eye = (
                3.2
                * radius
                * np.array([np.cos(lift) * np.sin(turn), np.sin(lift), np.cos(lift) * np.cos(turn)])
            )
            row.append(
                overview.view(
                    caster,
                    rigid.look_at(eye, np.zeros(3), np.array([0.0, 1.0, 0.0])),
                    intrinsics,
                    size_px,
                    size_px,
                )
            )
        rows.append(np.hstack(row))
    return np.vstack(rows)


def bone_colors(weights: Float[np.ndarray, "vertex bone"]) -> UInt8[np.ndarray, "vertex 3"]:
    """Mix one hue per bone by the skinning weights."""
    count = weights.shape[1]
    hue = np.array(
        [
            colorsys.hsv_to_rgb((7 * bone % count) / count, 0.75, 0.95 if bone % 2 else 0.7)
            for bone in range(count)
        ]
    )
    return np.round(255 * weights @ hue).astype(np.uint8)


def report(template: CanonicalTemplate) -> tuple[list[Check], list[Picture]]:
    """Return the stage's figures and pictures."""
    mesh = template.mesh
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    influence = template.weights.sum(0)
    checks = [
        Check("circle covered", template.around_deg, "deg", warn=330, fail=200, better="higher"),
        Check("agreement of depth pictures", 1000 * template.residual_m, "mm", warn=20, fail=50),
        Check("surface is closed", float(solid.is_watertight), "", warn=0.5, better="higher"),
        Check("length", float(np.ptp(mesh.vertices[:, 2])), "m"),
        Check("height", float(np.ptp(mesh.vertices[:, 1])), "m"),
        Check("volume", 1000 * float(abs(solid.volume)), "l"),
        Check("longer than wide (1 = ambiguous)", template.elongation, "", warn=1.3, better="higher"),
        Check("head against tail (50 = ambiguous)", 100 * template.head_share, "%", warn=55, better="higher"),
        Check(
            "bones that move less than 1 % of the surface",
            float((influence < 0.01 * influence.mean() * len(influence)).sum()),
            "",
            warn=8,
        ),
    ]
    bones = Mesh(mesh.vertices, mesh.faces, bone_colors(template.weights))
    pictures = [
        Picture("turntable", turntable(mesh), "the canonical animal, its head's side first"),
        Picture("bones", turntable(bones), "one hue per bone, mixed by the skinning weights"),
    ]
    return checks, pictures
