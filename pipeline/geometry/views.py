"""Pictures of a scene for people: a bird's-eye view with paths drawn on it, and shaded views."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.geometry.meshes import Mesh, RayCaster, render_view
from pipeline.geometry.subsampling import runs

EXTENT, MARGIN_M = (0.002, 0.998), 0.2
"""quantiles of vertices that span a picture, without stray ones, and the margin around them"""
UNCOLORED = 170
"""gray value of a surface without colors"""
BACKGROUND = 245


@dataclass(frozen=True)
class Overview:
    """A top-down picture in parallel projection: world x to the right, world z downwards."""

    image: UInt8[np.ndarray, "height width 3"]
    origin: Float[np.ndarray, "2"]
    """World (x, z) of the picture's upper left corner, meters."""
    meter_px: float

    def pixel(self, points_world: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point 2"]:
        """Return where points fall in the picture."""
        return (np.asarray(points_world)[:, [0, 2]] - self.origin) * self.meter_px

    def draw(
        self, points_world: Float[np.ndarray, "point 3"], color: tuple[int, int, int], thickness: int = 2
    ) -> None:
        """Draw a path into the picture; NaN points break it."""
        pixel = self.pixel(points_world)
        known = np.asarray(np.isfinite(pixel).all(1))
        for start, end in runs(known):
            line = np.round(pixel[start:end] * 8).astype(np.int32)
            cv2.polylines(self.image, [line[:, None]], False, color, thickness, cv2.LINE_AA, shift=3)


def bird_view(mesh: Mesh, *, floor_m: float, height_m: float = 1.7, width_px: int = 480) -> Overview:
    """Look straight down at a mesh (+y up) from ``height_m`` above the floor, below ceilings."""
    low, high = np.quantile(mesh.vertices[:, [0, 2]], EXTENT, axis=0)
    low, high = low - MARGIN_M, high + MARGIN_M
    meter_px = width_px / (high[0] - low[0])
    height_px = int(np.clip((high[1] - low[1]) * meter_px, 64, 4 * width_px))
    x, z = np.meshgrid(
        low[0] + (np.arange(width_px) + 0.5) / meter_px, low[1] + (np.arange(height_px) + 0.5) / meter_px
    )
    origins = np.stack([x, np.full_like(x, floor_m + height_m), z], axis=-1).reshape(-1, 3)
    hits = RayCaster(mesh).cast(origins, np.broadcast_to([0.0, -1.0, 0.0], origins.shape))
    return Overview(shade(mesh, hits).reshape(height_px, width_px, 3), low, meter_px)


def view(
    caster: RayCaster,
    world_from_camera: Float[np.ndarray, "4 4"],
    intrinsics: Float[np.ndarray, "3 3"],
    height: int,
    width: int,
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw a mesh with its vertex colors as a camera sees it."""
    _, hits = render_view(caster, world_from_camera, intrinsics, height, width)
    return shade(caster.mesh, hits).reshape(height, width, 3)


def shade(mesh: Mesh, hits) -> UInt8[np.ndarray, "ray 3"]:
    """Return the vertex colors at the hits, light gray where nothing was hit."""
    color = np.full((len(mesh.vertices), 3), UNCOLORED, np.uint8) if mesh.color is None else mesh.color
    painted = np.clip(np.round(hits.interpolate(mesh, color)), 0, 255).astype(np.uint8)
    return np.where((hits.face >= 0)[:, None], painted, np.uint8(BACKGROUND))
