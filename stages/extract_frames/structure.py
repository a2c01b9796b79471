"""Structure from motion by COLMAP, on one thread with fixed seeds.

`choose_keyframes` thins a video by motion in its pictures, `solve` finds poses and, if unknown, the
lens. The model's scale is its own.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float, Int, UInt8

from pipeline.core.progress import log
from pipeline.geometry import subsampling
from pipeline.mapping import colmap
from pipeline.mapping.colmap import SparseModel, read_sparse_model
from stages.extract_frames.config import PhotogrammetryConfig

MIN_KEYFRAMES = 8
"""minimum number of pictures of a model"""
PEAK_THRESHOLD = 0.004
"""SIFT's contrast threshold; plain walls need a low one (COLMAP's default is 0.0067)"""
VISUAL_WORDS, DESCRIPTORS_PER_WORD = 256, 40
"""size of the vocabulary, and descriptors of the recording per word to train it"""
MIN_PARALLAX_PAIRS = 0.03
"""minimum share of matched pairs with parallax, beyond a rotation or a homography"""
MOTION_WIDTH_PX = 240
"""width to which pictures are reduced before corners are tracked"""
LOST_STEP = 0.1
"""assumed motion, as a share of the width, if tracking is lost"""
MAX_CORNERS, WINDOW_PX = 200, (15, 15)
"""maximum number of corners of a picture, and window size of the tracker"""
MIN_CORNERS, MIN_TRACKED = 12, 0.4
"""number of corners, and share of them tracked, below which tracking is lost"""


@dataclass(frozen=True)
class Structure:
    """The largest model, its intrinsics, and the number of models."""

    sparse: SparseModel
    intrinsics: Float[np.ndarray, "3 3"]
    """Pixels of the input pictures."""
    radial: float
    """First radial distortion coefficient, OpenCV's and COLMAP's k1."""
    models: int


def motion_picture(color: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "small_height 240"]:
    """Reduce a picture for `motion`."""
    size = MOTION_WIDTH_PX, round(MOTION_WIDTH_PX * color.shape[0] / color.shape[1])
    return cv2.resize(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)


def motion(before: UInt8[np.ndarray, "height width"], after: UInt8[np.ndarray, "height width"]) -> float:
    """Return the motion of corners between two pictures, share of the width; `LOST_STEP` with too few."""
    corners = cv2.goodFeaturesToTrack(before, MAX_CORNERS, 0.01, 6)
    if corners is None or len(corners) < MIN_CORNERS:
        return LOST_STEP
    no_guess = np.zeros(0, np.float32)
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, corners, no_guess, winSize=WINDOW_PX, maxLevel=3
    )
    good = found[:, 0] == 1
    if good.sum() < MIN_TRACKED * len(corners):
        return LOST_STEP
    return float(np.median(np.linalg.norm((moved - corners)[good, 0], axis=1)) / before.shape[1])


def choose_keyframes(
    traveled: Float[np.ndarray, "frame"], sharpness: Float[np.ndarray, "frame"], config: PhotogrammetryConfig
) -> Int[np.ndarray, "key"]:
    """Pick the sharpest frame of every step of motion."""
    steps = min(traveled[-1] / config.keyframe_share, config.max_keyframes - 1)
    step = np.floor(traveled / max(traveled[-1], 1e-9) * steps).astype(int)
    return subsampling.sharpest_of_steps(step, sharpness)


def solve(
    pictures: Path,
    names: list[str],
    intrinsics: Float[np.ndarray, "3 3"] | None,
    config: PhotogrammetryConfig,
    workspace: Path,
    seed: int,
) -> Structure | None:
    """Pose the pictures ``names`` (six digits, in time order); None without a model of enough pictures."""
    colmap.seed_everything(seed)
    database = workspace / "database.db"
    reader = pycolmap.ImageReaderOptions(
        camera_model="SIMPLE_RADIAL", default_focal_length_factor=config.focal_share
    )
    sift = {"max_num_features": config.features, "peak_threshold": PEAK_THRESHOLD}
    reader = reader if intrinsics is None else colmap.pinhole(intrinsics)
    colmap.extract(database, pictures, names, reader, sift)
    pairs = _pairs(_descriptors(database, names), config, seed)
    colmap.match(database, ((names[first], names[second]) for first, second in pairs), seed)
    if _parallax_share(database) < MIN_PARALLAX_PAIRS:
        log("between none of the pictures the camera moves sideways: it turns on the spot")
        return None
    mapping = colmap.mapping_options(seed, calibrate=intrinsics is None)
    mapping.min_model_size = MIN_KEYFRAMES
    models = pycolmap.incremental_mapping(database, pictures, workspace, mapping)
    sizes = sorted((model.num_reg_images() for model in models.values()), reverse=True)
    log(f"COLMAP: {len(pairs)} pairs of {len(names)} keyframes; models of {sizes or 'no'} pictures")
    model = colmap.largest(models)
    if model is None or model.num_reg_images() < MIN_KEYFRAMES:
        return None
    camera = next(iter(model.cameras.values()))
    radial = float(camera.params[3]) if intrinsics is None else 0.0
    return Structure(read_sparse_model(model), camera.calibration_matrix(), radial, len(sizes))


def _parallax_share(database: Path) -> float:
    """Return the share of matched pairs with parallax."""
    kind = pycolmap.TwoViewGeometryConfiguration
    with pycolmap.Database.open(database) as table:
        found = [kind(geometry.config) for geometry in table.read_two_view_geometries()[1]]
    return float(np.mean([each in (kind.CALIBRATED, kind.UNCALIBRATED) for each in found])) if found else 0.0


def _descriptors(database: Path, names: list[str]) -> list[UInt8[np.ndarray, "feature 128"]]:
    with pycolmap.Database.open(database) as table:
        images = {image.name: image.image_id for image in table.read_all_images()}
        return [np.asarray(table.read_descriptors(images[name]).data) for name in names]


def _pairs(
    descriptors: list[np.ndarray], config: PhotogrammetryConfig, seed: int
) -> Int[np.ndarray, "pair 2"]:
    """Pair each keyframe with its successors and with those of the most similar words."""
    count = len(descriptors)
    first, second = np.triu_indices(count, 1)
    chosen = second - first <= config.overlap
    rooted = [np.sqrt(rows.astype(np.float32)) for rows in descriptors]
    similarity = _bag_of_words_similarity(rooted, VISUAL_WORDS, seed)
    for key in range(count):
        near = np.abs(np.arange(count) - key) <= config.overlap
        others = np.argsort(-np.where(near, -1.0, similarity[key]), kind="stable")
        for other in others[: config.retrieved]:
            if similarity[key, other] > 0 and abs(other - key) > config.overlap:
                chosen |= (first == min(key, other)) & (second == max(key, other))
    return np.stack([first[chosen], second[chosen]], axis=1)


def _bag_of_words_similarity(
    descriptors: list[np.ndarray], words: int, seed: int
) -> Float[np.ndarray, "key key"]:
    """Return the cosine of word histograms, words weighted by rarity (Sivic and Zisserman 2003)."""
    everything = np.concatenate(descriptors)
    order = np.random.default_rng(seed).permutation(len(everything))
    sample = everything[order[: DESCRIPTORS_PER_WORD * words]]
    if len(sample) < words:
        return np.zeros((len(descriptors), len(descriptors)))
    cv2.setRNGSeed(seed)
    no_guess, rounds = np.zeros(0, np.int32), (cv2.TERM_CRITERIA_MAX_ITER, 8, 0)
    centers = cv2.kmeans(sample, words, no_guess, rounds, 1, cv2.KMEANS_PP_CENTERS)[2]
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    nearest = ([match.trainIdx for match in matcher.match(rows, centers)] for rows in descriptors)
    counts = np.stack([np.bincount(held, minlength=words) for held in nearest])
    weighted = np.sqrt(counts) * np.log(len(counts) / np.maximum((counts > 0).sum(0), 1))
    weighted /= np.maximum(np.linalg.norm(weighted, axis=1, keepdims=True), 1e-9)
    return weighted @ weighted.T
