"""Refine the walk-through's cameras: keyframes against each other, then every frame against the fused surface.

Keyframes are tied by what they share: SfM tracks (sideways, by pixel noise) and overlapping depth
(along surface normals), with odometry between neighbours. All terms are contacts of `pipeline.space.relax`.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from pipeline.files.clips import Clip
from pipeline.space import cameras, relax, rigid, surface
from pipeline.space.sparse import Sparse
from stages.build_scene_template.matches import points_under


@dataclass(frozen=True)
class RefineOptions:
    """Weights and reach of the refinement."""

    pixel_sigma_px: float = 1.5
    """Standard deviation of a SIFT feature's position, colour pixels."""
    depth_inflation: float = 4.0
    """Depth noise is multiplied by this, since neighbouring pixels err together."""
    drift_deg_s: float = 0.5
    """Odometry's rotational drift, degrees a second."""
    drift_m_s: float = 0.02
    """Odometry's translational drift, metres a second."""
    stride_px: int = 10
    """One depth pixel in so many, each way, is used."""
    neighbours: int = 8
    """Keyframes that each keyframe's depth is compared with."""
    rounds: int = 10
    """Gauss-Newton steps of the keyframe graph."""


@dataclass(frozen=True)
class Keyframe:
    """What the refinement keeps of one keyframe: thinned points, and the full depth to compare with."""

    scan: surface.Scan
    depth: Float[np.ndarray, "height width"]
    normals: Float[np.ndarray, "height width 3"]
    intrinsics: Float[np.ndarray, "3 3"]


def load_keyframe(clip: Clip, frame: int, stride_px: int) -> Keyframe:
    """Read one frame's depth, its thinned points and its normals (camera axes, zero where unknown)."""
    depth, intrinsics = clip.depth(frame), clip.depth_intrinsics[frame]
    depth = np.where(clip.confidence(frame) >= 1, depth, 0)
    return Keyframe(surface.scan(depth, intrinsics, stride=stride_px), depth, surface.image_normals(depth, intrinsics), intrinsics)


def depth_contacts(
    keyframes: list[Keyframe],
    pairs: Int[np.ndarray, "pair 2"],
    world_from_camera: Float[np.ndarray, "key 4 4"],
    reach_m: float,
    inflation: float,
) -> relax.Contacts:
    """Project each pair's thinned points into the other's depth image and tie them to the plane seen there."""
    parts = [_pair_contacts(keyframes, int(a), int(b), world_from_camera, reach_m, inflation) for a, b in pairs]
    return relax.Contacts.join(*parts)


def _pair_contacts(keyframes, first, second, world_from_camera, reach_m, inflation):
    source, target = keyframes[first].scan, keyframes[second]
    second_from_first = rigid.inverse(world_from_camera[second]) @ world_from_camera[first]
    moved = rigid.apply(second_from_first, source.points_camera)
    pixel, z = cameras.project(moved, target.intrinsics)
    column, row = np.floor(pixel).astype(int).T
    height, width = target.depth.shape
    inside = np.flatnonzero((z > 0.1) & (row >= 0) & (column >= 0) & (row < height) & (column < width))
    row, column = row[inside], column[inside]
    met = cameras.unproject(pixel[inside], target.intrinsics) * target.depth[row, column, None]
    normal = target.normals[row, column]
    gap = np.abs(np.einsum("ci,ci->c", moved[inside] - met, normal))
    good = (np.abs(normal).sum(1) > 0) & (gap < 1.5 * reach_m)
    inside, met, normal = inside[good], met[good], normal[good]
    count = len(inside)
    sigma = inflation * np.hypot(source.sigma_m[inside], surface.depth_noise(met[:, 2]))
    return relax.Contacts(
        np.full(count, first),
        np.full(count, second),
        source.points_camera[inside],
        met,
        normal @ world_from_camera[second, :3, :3].T,
        sigma,
    )


@dataclass(frozen=True)
class Ties:
    """Depth points under the same SfM track in two keyframes, camera axes, and their sideways noise."""

    first: Int[np.ndarray, "tie"]
    second: Int[np.ndarray, "tie"]
    points_first: Float[np.ndarray, "tie 3"]
    points_second: Float[np.ndarray, "tie 3"]
    sigma_m: Float[np.ndarray, "tie"]

    def contacts(self, world_from_camera: Float[np.ndarray, "key 4 4"]) -> relax.Contacts:
        """Tie the points across the second camera's viewing ray: along the ray depth is the better witness."""
        ray = self.points_second / np.linalg.norm(self.points_second, axis=1, keepdims=True)
        sides = []
        for axis in (np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])):
            side = axis - (ray @ axis)[:, None] * ray
            side /= np.linalg.norm(side, axis=1, keepdims=True)
            direction = np.einsum("cij,cj->ci", world_from_camera[self.second, :3, :3], side)
            sides.append(relax.Contacts(self.first, self.second, self.points_first, self.points_second, direction, self.sigma_m))
        return relax.Contacts.join(*sides)


def tie_tracks(sparse: Sparse, clip: Clip, key_of_view: Int[np.ndarray, "view"], sigma_px: float) -> Ties:
    """Pair each observation of a track that has depth with the track's next one and the third after it."""
    points = np.full((len(sparse.observed_key), 3), np.nan)
    for view, frame in enumerate(sparse.frame):
        row = np.flatnonzero(sparse.observed_key == view)
        points[row] = points_under(clip, int(frame), sparse.observed_pixel[row])
    order = np.lexsort((sparse.observed_key, sparse.observed_point))
    order = order[np.isfinite(points[order, 0])]
    track = sparse.observed_point[order]
    ties = [np.stack([order[:-hop], order[hop:]], 1)[track[:-hop] == track[hop:]] for hop in (1, 3) if len(order) > hop]
    first, second = np.concatenate([np.zeros((0, 2), int), *ties]).T
    focal = clip.intrinsics[sparse.frame[sparse.observed_key[second]], 0, 0]
    views = [key_of_view[sparse.observed_key[index]] for index in (first, second)]
    return Ties(*views, points[first], points[second], sigma_px * points[second, 2] / focal)


def overlapping(world_from_camera: Float[np.ndarray, "key 4 4"], keyframes: list[Keyframe], neighbours: int) -> Int[np.ndarray, "pair 2"]:
    """Pick for each keyframe its successor and the others that see most of its points."""
    pairs = []
    for first, keyframe in enumerate(keyframes):
        points = keyframe.scan.points_camera[::7]
        seen = np.zeros(len(keyframes))
        for second in range(len(keyframes)):
            local = rigid.apply(rigid.inverse(world_from_camera[second]) @ world_from_camera[first], points)
            pixel, z = cameras.project(local, keyframe.intrinsics)
            inside = (z > 0.1) & (pixel > 0).all(1) & (pixel < np.array(keyframe.depth.shape[::-1])).all(1)
            seen[second] = inside.mean() if len(points) else 0
        seen[first] = 0
        spread = np.argsort(-seen, kind="stable")
        best = spread[seen[spread] > 0.3]
        chosen = set(best[:: max(1, len(best) // neighbours)][:neighbours].tolist()) | (
            {first + 1} if first + 1 < len(keyframes) else set()
        )
        pairs += [(first, second) for second in sorted(chosen)]
    return np.array(pairs).reshape(-1, 2)


def refine_keyframes(
    clip: Clip,
    frames: Int[np.ndarray, "key"],
    keyframes: list[Keyframe],
    world_from_camera: Float[np.ndarray, "key 4 4"],
    sparse: Sparse | None,
    options: RefineOptions,
) -> Float[np.ndarray, "key 4 4"]:
    """Relax the keyframes against each other by depth, tracks and odometry; the first one stays where it is."""
    pairs = overlapping(world_from_camera, keyframes, options.neighbours)
    ties = None if sparse is None else tie_tracks(sparse, clip, np.searchsorted(frames, sparse.frame), options.pixel_sigma_px)

    def find(poses, reach_m):
        contacts = depth_contacts(keyframes, pairs, poses, reach_m, options.depth_inflation)
        return contacts if ties is None else relax.Contacts.join(contacts, ties.contacts(poses))

    held = np.arange(len(frames)) == 0
    reach = tuple(np.geomspace(0.15, 0.04, options.rounds))
    return relax.relax(world_from_camera, find, odometry_edges(clip, frames, options), reach_m=reach, held=held).world_from_camera


def odometry_edges(clip: Clip, frames: Int[np.ndarray, "key"], options: RefineOptions) -> relax.Relatives | None:
    """Return the odometry between neighbouring frames of a selection, None where the phone gave none."""
    if clip.odometry_from_camera is None:
        return None
    drift = np.deg2rad(options.drift_deg_s)
    return relax.chain(clip.timestamp_s[frames], clip.odometry_from_camera[frames], drift_rad_s=drift, drift_m_s=options.drift_m_s)
