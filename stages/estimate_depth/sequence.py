"""Place a whole plain video in the map by its own structure from motion.

Bare walls and repeating floors match the map in many places, so that no single picture is certain. The whole
video fits in one: `reconstruct` makes its cameras and points at a scale of their own, and `align` finds the
similarity transform to the map that puts most of the points on their landmarks, by RANSAC.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import scipy.optimize
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from pipeline.core.progress import log
from pipeline.data.clips import Pictures
from pipeline.geometry import align as alignment
from pipeline.geometry import rigid, subsampling
from pipeline.mapping import colmap
from pipeline.mapping.colmap import SparseModel
from stages.estimate_depth.landmarks import Matches
from stages.estimate_depth.lens import INLIER_SHARE, Lens, nominal

FRAMES, GAPS = 100, (1, 2, 4, 8)
"""Largest number of frames, and the gaps between those that are matched."""
SIFT = {"max_num_features": 1500, "peak_threshold": 0.004}
"""COLMAP's options of keypoints; plain walls need a low contrast threshold."""
SAME_PX = 1.5
"""Largest distance of a matched keypoint from the observation of its point, pixels."""
TRIPLETS, BATCH, HYPOTHESES = 200_000, 2_000, 3_000
"""Most triplets that RANSAC draws, at a time, and hypotheses that it tests: one match in 20 may be right."""
MIN_SIDE_M, MAX_MISFIT = 0.3, 0.15
"""Least extent of a triplet, meters, and largest difference of its two shapes, share of the extent."""
CELL_M = 0.03
"""Landmarks of one cell count once."""
OUTSIDE_M = 0.3
"""How far cameras may be from the map's bounding box, meters."""
INLIER_FACTOR = 2.0
"""RANSAC threshold, in those of single pictures: the focal length is not yet refined."""
ROUNDS, REFINED = 3, 5
"""Refinements on the inliers, and hypotheses that are refined."""
MIN_POINTS, MIN_LEAD = 15, 1.5
"""Points on their landmarks that an alignment needs, and their ratio to the best one elsewhere."""
ELSEWHERE_M = 0.5
"""Mean distance of its cameras that makes an alignment another one, meters."""


@dataclass(frozen=True)
class PointMatches:
    """Points of the video's model and the landmarks that their keypoints match, each pair once."""

    point: Int[np.ndarray, "pair"]
    landmark: Int[np.ndarray, "pair"]
    """Number of the landmark's cell."""
    points_model: Float[np.ndarray, "pair 3"]
    points_world: Float[np.ndarray, "pair 3"]
    pixel: Float[np.ndarray, "pair 2"]
    camera_from_model: Float[np.ndarray, "pair 4 4"]
    """Of the frame with the keypoint."""

    def __getitem__(self, rows: Int[np.ndarray, "chosen"] | Bool[np.ndarray, "pair"]) -> "PointMatches":
        """Return some of the pairs."""
        return PointMatches(*(column[rows] for column in vars(self).values()))

    @property
    def support(self) -> int:
        """Return how many different points and landmarks agree."""
        return min(len(np.unique(self.point)), len(np.unique(self.landmark)))

    def off_px(self, model_from_world: Float[np.ndarray, "4 4"], lens: Lens) -> Float[np.ndarray, "pair 2"]:
        """Return the reprojection errors of the landmarks; infinite behind the camera."""
        camera_from_world = self.camera_from_model @ model_from_world
        points = rigid.apply(camera_from_world, self.points_world[:, None])[:, 0]
        return np.where(points[:, 2:] > 0, lens.project(points) - self.pixel, np.inf)

    def inliers(self, model_from_world: Float[np.ndarray, "4 4"], lens: Lens) -> "PointMatches":
        """Return the pairs that agree with a similarity transform."""
        limit_px = INLIER_FACTOR * INLIER_SHARE * max(lens.size)
        return self[np.linalg.norm(self.off_px(model_from_world, lens), axis=1) < limit_px]


def place(
    pictures: Pictures,
    matches: Sequence[Matches],
    lens: Lens | None,
    bounds: Float[np.ndarray, "2 3"],
    seed: int,
) -> tuple[Lens, Float[np.ndarray, "frame 4 4"]] | None:
    """Return the lens and the cameras, NaN where unknown; None if no place in the map stands out.

    ``matches`` are the landmarks of each frame, ``bounds`` the map's least and largest coordinates, meters.
    Without a ``lens``, its focal length is estimated.
    """
    found = reconstruct(pictures, lens or nominal(pictures.color_size), seed, calibrate=lens is None)
    if found is None:
        return None
    model, lens = found
    model_from_world = align(model, match_points(model, matches), lens, bounds, seed)
    if model_from_world is None:
        return None
    poses = np.full((len(pictures), 4, 4), np.nan)
    poses[model.frame] = cameras_of(model, model_from_world)
    return lens, poses


def reconstruct(
    pictures: Pictures, start: Lens, seed: int, *, calibrate: bool
) -> tuple[SparseModel, Lens] | None:
    """Return the video's largest model and the lens (``calibrate``: with its focal length), or None."""
    names = [f"{frame:06d}.jpg" for frame in subsampling.evenly(len(pictures), FRAMES)]
    pairs = [(names[at], names[at + gap]) for gap in GAPS for at in range(len(names) - gap)]
    (height, width), folder = start.size, pictures.folder / "color"
    parameters = f"{start.focal_px},{width / 2},{height / 2},{start.radial}"
    reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL", camera_params=parameters)
    colmap.seed_everything(seed)
    with tempfile.TemporaryDirectory() as workspace:
        database = Path(workspace) / "database.db"
        colmap.extract(database, folder, names, reader, SIFT)
        colmap.match(database, pairs, seed)
        options = colmap.mapping_options(seed, calibrate=calibrate)
        options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = False
        models = pycolmap.incremental_mapping(database, folder, Path(workspace), options)
    model = colmap.largest(models)
    if model is None:
        return None
    focal_px = float(next(iter(model.cameras.values())).params[0])
    log(f"structure from motion: {model.num_reg_images()} of {len(names)} frames, focal {focal_px:.1f} px")
    return colmap.read_sparse_model(model), Lens(focal_px, start.radial, start.size)


def match_points(model: SparseModel, matches: Sequence[Matches]) -> PointMatches:
    """Join the observations of the model's points with the landmarks that their keypoints match."""
    columns: list[tuple[np.ndarray, ...]] = []
    for key, frame in enumerate(model.frame.tolist()):
        seen, own = np.flatnonzero(model.observed_key == key), matches[frame]
        distance, nearest = map(np.asarray, KDTree(model.observed_pixel[seen]).query(own.pixel))
        same = distance < SAME_PX
        point = model.observed_point[seen[nearest[same]]]
        columns.append((point, np.full(len(point), key), own.pixel[same], own.points_world[same]))
    point, key, pixel, world = (np.concatenate(column) for column in zip(*columns, strict=True))
    landmark = np.unique(np.round(world / CELL_M), axis=0, return_inverse=True)[1].reshape(-1)
    camera_from_model = rigid.inverse(model.model_from_camera)[key]
    pairs = PointMatches(point, landmark, model.points_model[point], world, pixel, camera_from_model)
    return pairs[np.unique(np.stack([point, landmark], axis=1), axis=0, return_index=True)[1]]


def align(
    model: SparseModel, pairs: PointMatches, lens: Lens, bounds: Float[np.ndarray, "2 3"], seed: int
) -> Float[np.ndarray, "4 4"] | None:
    """Return ``model_from_world``, a similarity transform, or None if no place stands out."""
    if len(pairs.point) < MIN_POINTS:
        return None
    rng, tested = np.random.default_rng(seed), []
    for _ in range(0, TRIPLETS, BATCH):
        triplets = rng.integers(0, len(pairs.point), (BATCH, 3))
        for hypothesis in _similarities(pairs.points_model[triplets], pairs.points_world[triplets]):
            center = cameras_of(model, hypothesis)[:, :3, 3]
            if ((center > bounds[0] - OUTSIDE_M) & (center < bounds[1] + OUTSIDE_M)).all():
                tested.append((pairs.inliers(hypothesis, lens).support, hypothesis, center))
        if len(tested) >= HYPOTHESES:
            break
    tested.sort(key=lambda each: -each[0])
    refined = [_refined(pairs, hypothesis, lens) for _, hypothesis, _ in tested[:REFINED]]
    if not refined:
        return None
    support, chosen = max(refined, key=lambda each: each[0])
    place = cameras_of(model, chosen)[:, :3, 3]

    def is_elsewhere(centers) -> bool:
        return np.linalg.norm(centers - place, axis=1).mean() > ELSEWHERE_M

    others = [hypothesis for _, hypothesis, centers in tested if is_elsewhere(centers)][:REFINED]
    refined = [_refined(pairs, each, lens) for each in others]
    rival = max((n for n, other in refined if is_elsewhere(cameras_of(model, other)[:, :3, 3])), default=0)
    log(f"{support} points of the video fit the map in one place, {rival} in the next best")
    return chosen if support >= max(MIN_POINTS, MIN_LEAD * rival) else None


def cameras_of(
    model: SparseModel, model_from_world: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "key 4 4"]:
    """Return the model's cameras in the world."""
    placed = np.linalg.inv(model_from_world) @ model.model_from_camera
    placed[:, :3, :3] *= np.cbrt(np.linalg.det(model_from_world[:3, :3]))
    return placed


def _similarities(points_model, points_world) -> Float[np.ndarray, "good 4 4"]:
    """Return ``model_from_world`` of the triplets whose shapes agree."""
    both = points_model, points_world
    extent, extent_m = (np.linalg.norm(each - each.mean(1, keepdims=True), axis=(1, 2)) for each in both)
    scale = extent / np.maximum(extent_m, MIN_SIDE_M)
    scaled = points_world * scale[:, None, None]
    found = alignment.kabsch(scaled, points_model)
    misfit = np.linalg.norm(rigid.apply(found, scaled) - points_model, axis=2).max(1)
    found[:, :3, :3] *= scale[:, None, None]
    return found[(extent_m > MIN_SIDE_M) & (misfit < MAX_MISFIT * extent)]


def _refined(pairs: PointMatches, model_from_world, lens: Lens) -> tuple[int, Float[np.ndarray, "4 4"]]:
    """Refine a similarity transform on its inliers, and return their support with it."""
    for _ in range(ROUNDS):
        inliers = pairs.inliers(model_from_world, lens)
        if inliers.support < 3:
            break
        middle = inliers.points_world.mean(0)

        def moved(values, start=model_from_world, middle=middle):
            motion = np.eye(4)
            motion[:3, :3] = np.exp(values[6]) * Rotation.from_rotvec(values[:3]).as_matrix()
            motion[:3, 3] = middle + values[3:6] - motion[:3, :3] @ middle
            return start @ motion

        def residuals(values, inliers=inliers, moved=moved):
            return np.minimum(inliers.off_px(moved(values), lens), max(lens.size)).ravel()

        fitted = scipy.optimize.least_squares(residuals, np.zeros(7), loss="soft_l1", x_scale="jac")
        model_from_world = moved(fitted.x)
    return pairs.inliers(model_from_world, lens).support, model_from_world
