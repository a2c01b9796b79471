"""Align a whole recording to the template at once: odometry, frame votes, depth and pictures in one robust relaxation.

Depth ties every frame to the surface along its normals (the agent masked out, moved furniture weighed
down); votes tie points to points; in a second pass optical flow between the rendered template and the
picture ties what depth leaves free to slide along walls.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.files.clips import Clip, Masks
from pipeline.progress import track
from pipeline.space import cameras, relax, rigid, surface
from pipeline.space.meshes import Mesh, RayCaster
from stages.register_videos.comparing import compare
from stages.register_videos.votes import Votes

LEAST_POINTS = 20
"""Points of static depth without which a frame tells nothing of its fit."""


@dataclass(frozen=True)
class AlignOptions:
    """Weights, reach and rounds of the alignment."""

    stride_px: int = 11
    """One depth pixel in so many, each way, takes part."""
    most_points: int = 400_000
    """Depth points of a recording that take part; scans of longer ones are thinned evenly, so that memory stays bounded ..."""
    least_points: int = 40
    """... but a scan keeps so many."""
    depth_inflation: float = 8.0
    """Depth noise is multiplied by this, since neighbouring pixels err together and furniture moves."""
    vote_sigma_m: float = 0.15
    """Standard deviation of one matched patch of a vote, metres."""
    drift_deg_s: float = 0.15
    """Odometry's rotational drift, degrees a second."""
    drift_m_s: float = 0.01
    """Odometry's translational drift, metres a second."""
    first_reach_m: float = 0.3
    """Width of the robust weight in the first round, metres."""
    last_reach_m: float = 0.04
    """Width in the last round, metres."""
    rounds: int = 8
    """Gauss-Newton steps by depth and votes; 0: poses stay as votes and odometry give them."""
    picture_every_frames: int = 5
    """One frame in so many is compared with the rendered template; 0: none."""
    picture_rounds: int = 1
    """Passes of rendering, flow and relaxation."""
    picture_px: float = 16.0
    """Standard deviation of the flow between rendering and picture, pixels at half size; neighbouring pixels err together."""
    picture_return_px: float = 1.0
    """Flow there and back must return to within this, pixels at half size: mirrors and moved things do not."""
    picture_stride_px: int = 9
    """One pixel of the half-size picture in so many, each way, takes part."""


@dataclass(frozen=True)
class Aligned:
    """The aligned cameras and how well each frame's depth fits."""

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    spread: Float[np.ndarray, "frame 6 6"]
    """Covariance of each camera's right-hand twist (rotation in radians, translation in metres)."""
    scans: list[surface.Scan]
    gap_m: Float[np.ndarray, "frame"]
    """Median distance of the static depth from the surface; NaN where nothing was in reach."""
    fit: Float[np.ndarray, "frame"]
    """Share of the static depth within 5 cm of the surface, of what lies within half a metre of it; NaN where there is no
    static depth to measure.
    """

    @property
    def usual_gap_m(self) -> float:
        """Return the median frame's gap; NaN where no frame was measured."""
        return _median(self.gap_m)

    @property
    def usual_fit(self) -> float:
        """Return the median frame's fit; NaN where no frame was measured."""
        return _median(self.fit)


def align(
    clip: Clip,
    masks: Masks,
    mesh: Mesh,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    edges: relax.Relatives,
    votes: Votes,
    supports: Bool[np.ndarray, "vote"],
    options: AlignOptions,
) -> Aligned:
    """Relax all frames: first votes and motions, then depth from coarse to fine, then pictures as well."""
    place, frames = surface.Surface(mesh), np.arange(len(clip))
    most = max(options.most_points // len(clip), options.least_points)
    scans = [_static_scan(clip, masks, int(frame), options, most) for frame in track(frames, "reading depth")]
    voted = _vote_contacts(votes, supports, options)

    seen: list[relax.Contacts] = []

    def find(poses, reach_m):
        depth = place.contacts(frames, scans, poses, reach_m)
        sigma = depth.sigma_m * options.depth_inflation
        depth = relax.Contacts(depth.first, depth.second, depth.points_first, depth.points_second, depth.direction_world, sigma)
        return relax.Contacts.join(depth, *voted, *seen)

    reach = tuple(np.geomspace(options.first_reach_m, options.last_reach_m, options.rounds))
    poses = world_from_camera
    if options.rounds and voted:
        poses = relax.relax(poses, lambda *_: relax.Contacts.join(*voted), edges, reach_m=(options.first_reach_m,) * 3).world_from_camera
    if options.rounds:
        poses = relax.relax(poses, find, edges, reach_m=reach).world_from_camera
    caster = RayCaster(mesh)
    for _ in range(options.picture_rounds if options.picture_every_frames else 0):
        chosen = frames[:: options.picture_every_frames]
        seen[:] = [
            tie
            for frame in track(chosen, "comparing pictures")
            if (tie := picture_contacts(clip, masks, caster, int(frame), poses[frame], options)) is not None
        ]
        poses = relax.relax(poses, find, edges, reach_m=(options.last_reach_m,) * 3).world_from_camera
    spread = relax.spread(poses, find(poses, options.last_reach_m), edges, options.last_reach_m)
    return Aligned(poses, spread, scans, *measure_fit(place, scans, poses))


def odometry_edges(
    timestamp_s: Float[np.ndarray, "frame"], odometry_from_camera: Float[np.ndarray, "frame 4 4"], options: AlignOptions
) -> relax.Relatives:
    """Return the phone's own motions between neighbouring frames."""
    return relax.chain(timestamp_s, odometry_from_camera, drift_rad_s=np.deg2rad(options.drift_deg_s), drift_m_s=options.drift_m_s)


def measure_fit(
    place: surface.Surface, scans: list[surface.Scan], world_from_camera: Float[np.ndarray, "frame 4 4"]
) -> tuple[Float[np.ndarray, "frame"], Float[np.ndarray, "frame"]]:
    """Return each frame's median gap (metres) and the share of its depth within 5 cm of the surface, of that within
    50 cm; NaN for frames that measured too few points, and no share at all where they lie nowhere near.
    """
    gap, fit = np.full(len(scans), np.nan), np.full(len(scans), np.nan)
    for frame, scan in enumerate(scans):
        if len(scan.points_camera) >= LEAST_POINTS:
            distance = np.abs(place.distance(rigid.apply(world_from_camera[frame], scan.points_camera)))
            near, fit[frame] = distance[distance < 0.5], 0.0
            if len(near) >= LEAST_POINTS:
                gap[frame], fit[frame] = np.median(near), (near < 0.05).mean()
    return gap, fit


def _median(values):
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def _static_scan(clip, masks, frame, options, most):
    ignore = cv2.resize((masks[frame] > 0).astype(np.uint8), clip.depth_size[::-1], interpolation=cv2.INTER_NEAREST)
    ignore = cv2.dilate(ignore, np.ones((7, 7), np.uint8)) > 0
    found = surface.scan(
        clip.depth(frame),
        clip.depth_intrinsics[frame],
        stride=options.stride_px,
        confidence=clip.confidence(frame),
        ignore=ignore,
    )
    return found.thinned(most)


def _vote_contacts(votes, supports, options):
    contacts = []
    for vote in np.flatnonzero(supports):
        answer = votes.answers[vote]
        count = len(answer.points_map)
        first, second = np.full(count, votes.frame[vote]), np.full(count, relax.MAP)
        for axis in np.eye(3):
            direction = np.broadcast_to(axis, (count, 3))
            contacts.append(
                relax.Contacts(
                    first,
                    second,
                    answer.points_camera,
                    answer.points_map,
                    direction,
                    np.full(count, options.vote_sigma_m),
                )
            )
    return contacts


def picture_contacts(
    clip: Clip,
    masks: Masks,
    caster: RayCaster,
    frame: int,
    world_from_camera: Float[np.ndarray, "4 4"],
    options: AlignOptions,
) -> relax.Contacts | None:
    """Tie one frame to the template by optical flow from its rendering to the picture, across the viewing rays."""
    seen = compare(clip, masks, caster, frame, world_from_camera)
    known, size, intrinsics = seen.known, seen.known.shape, seen.intrinsics
    if known.mean() < 0.1:
        return None
    flow, astray_px = _flow(even(seen.rendered, known), even(seen.recorded, known))
    rows, columns = np.mgrid[4 : size[0] - 4 : options.picture_stride_px, 4 : size[1] - 4 : options.picture_stride_px].reshape(2, -1)
    start = np.stack([columns, rows], axis=-1) + 0.5
    end = start + flow[rows, columns]
    ray = cameras.unproject(end, intrinsics)
    pixel, _ = cameras.project(ray, clip.depth_intrinsics[frame])
    limit = np.array(clip.depth_size[::-1]) - 1
    column, row = np.clip(pixel.astype(int), 0, limit).T
    z = clip.depth(frame)[row, column]
    good = (
        known[rows, columns]
        & (pixel > 0).all(1)
        & (pixel < limit).all(1)
        & (np.abs(z - seen.depth[rows, columns]) < 0.12)
        & (np.abs(flow[rows, columns]).max(1) < 12)
        & (astray_px[rows, columns] < options.picture_return_px)
    )
    if good.sum() < 20:
        return None
    mapped = rigid.apply(world_from_camera, (cameras.unproject(start, intrinsics) * seen.depth[rows, columns][:, None])[good])
    return _sideways(frame, ray[good] * z[good, None], mapped, world_from_camera, options.picture_px / intrinsics[0, 0])


def _flow(first, second):
    """Return optical flow and how far from its start it ends there and back, pixels; far outside the picture."""
    dense = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    there, back = dense.calc(first, second, None), dense.calc(second, first, None)
    row, column = np.mgrid[: first.shape[0], : first.shape[1]].astype(np.float32)
    returned = cv2.remap(back, column + there[..., 0], row + there[..., 1], cv2.INTER_LINEAR, borderValue=(1e3, 1e3))
    return there, np.linalg.norm(there + returned, axis=-1)


def _sideways(frame, points_camera, points_map, world_from_camera, sigma_per_m):
    count = len(points_camera)
    first, second, sigma = np.full(count, frame), np.full(count, relax.MAP), sigma_per_m * points_camera[:, 2]
    sides = [np.broadcast_to(world_from_camera[:3, axis], (count, 3)) for axis in (0, 1)]
    return relax.Contacts.join(*(relax.Contacts(first, second, points_camera, points_map, side, sigma) for side in sides))


def even(color: Float[np.ndarray, "height width 3"], known: Bool[np.ndarray, "height width"]) -> UInt8[np.ndarray, "height width"]:
    """Remove differences of light: grey values minus their local mean over their local spread, unknown pixels flat."""
    gray = cv2.cvtColor(color.astype(np.float32), cv2.COLOR_RGB2GRAY)
    weight = known.astype(np.float32)
    share = _blur(weight) + 1e-3
    mean = _blur(gray * weight) / share
    spread = np.sqrt(np.maximum(_blur((gray - mean) ** 2 * weight) / share, 9.0))
    return np.clip(128 + 48 * (gray - mean) / spread * weight, 0, 255).astype(np.uint8)


def _blur(picture, sigma_px=9):
    return cv2.GaussianBlur(picture, (0, 0), sigma_px)
