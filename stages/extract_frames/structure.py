"""Where the camera stood, from pictures alone: keyframes by their motion, then COLMAP, on one thread with fixed seeds.

`choose_keyframes` thins a video by what its pictures show, `solve` finds poses and, where nothing tells it, the lens.
The model's scale is its own.
"""

import itertools
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float, Int, UInt8

from pipeline.progress import log
from pipeline.space import colmap
from pipeline.space.sparse import Sparse, sparse_from_model


@dataclass(frozen=True)
class StructureOptions:
    """How pictures are chosen, matched and mapped."""

    keyframe_share: float = 0.06
    """A keyframe follows the last one when the picture has moved by this share of its width."""
    most_keyframes: int = 120
    """Upper bound; steps are widened until it holds."""
    least_keyframes: int = 8
    """A model with fewer pictures is none."""
    features: int = 2000
    """SIFT features kept per keyframe."""
    peak_threshold: float = 0.004
    """SIFT's contrast threshold; plain walls need a low one."""
    overlap: int = 8
    """Keyframes matched with this many successors."""
    look_alikes: int = 8
    """And with so many others that share the most visual words."""
    words: int = 256
    """Visual words, learned from the recording itself."""
    least_telling: float = 0.03
    """Share of the matched pairs that must show depth, not a mere turn or one plane."""
    focal_share: float = 0.85
    """Focal length that calibration begins from, share of the picture's longer side."""


@dataclass(frozen=True)
class Structure:
    """The largest model, the lens it was seen through, and how many models the pictures fell into."""

    sparse: Sparse
    intrinsics: Float[np.ndarray, "3 3"]
    """Pixels of the pictures that were given."""
    radial: float
    """First radial distortion coefficient, OpenCV's and COLMAP's k1."""
    models: int


class Motion:
    """How far the picture has moved since the first one, shares of its width, picture by picture."""

    def __init__(self) -> None:
        self.travelled: list[float] = []
        self._last: UInt8[np.ndarray, "height width"] | None = None

    def add(self, gray: UInt8[np.ndarray, "height width"]) -> None:
        """Follow corners into the next picture; where too few survive, it counts as moved by a tenth of its width."""
        small = cv2.resize(gray, (240, round(240 * gray.shape[0] / gray.shape[1])), interpolation=cv2.INTER_AREA)
        step = 0.0 if self._last is None else self._step(self._last, small)
        self.travelled.append(step + (self.travelled[-1] if self.travelled else 0.0))
        self._last = small

    @staticmethod
    def _step(before: np.ndarray, after: np.ndarray) -> float:
        corners = cv2.goodFeaturesToTrack(before, 200, 0.01, 6)
        if corners is None or len(corners) < 12:
            return 0.1
        moved, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None, winSize=(15, 15), maxLevel=3)
        good = found[:, 0] == 1
        if good.sum() < 0.4 * len(corners):
            return 0.1
        return float(np.median(np.linalg.norm((moved - corners)[good, 0], axis=1)) / before.shape[1])


def choose_keyframes(
    travelled: Float[np.ndarray, "frame"], sharpness: Float[np.ndarray, "frame"], options: StructureOptions
) -> Int[np.ndarray, "key"]:
    """Pick the sharpest frame of every step of motion."""
    steps = min(travelled[-1] / options.keyframe_share, options.most_keyframes - 1)
    step = np.floor(travelled / max(travelled[-1], 1e-9) * steps).astype(int)
    starts = np.flatnonzero(np.diff(step, prepend=-1) > 0)
    bounds = np.append(starts, len(step))
    return np.array([low + int(sharpness[low:high].argmax()) for low, high in itertools.pairwise(bounds)])


def solve(
    pictures: Path, names: list[str], intrinsics: Float[np.ndarray, "3 3"] | None, options: StructureOptions, workspace: Path, seed: int
) -> Structure | None:
    """Pose the pictures ``names`` (six digits, in time order); None where no model of enough of them comes out."""
    colmap.seed_everything(seed)
    database = workspace / "database.db"
    reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL", default_focal_length_factor=options.focal_share)
    sift = {"max_num_features": options.features, "peak_threshold": options.peak_threshold}
    colmap.extract(database, pictures, names, reader if intrinsics is None else colmap.pinhole(intrinsics), sift)
    pairs = _pairs(_descriptors(database, names), options, seed)
    colmap.match(database, ((names[first], names[second]) for first, second in pairs), seed)
    if _telling(database) < options.least_telling:
        log("between none of the pictures the camera moves sideways: it turns on the spot")
        return None
    mapping = colmap.mapping_options(seed, calibrate=intrinsics is None)
    mapping.min_model_size = options.least_keyframes
    models = pycolmap.incremental_mapping(database, pictures, workspace, mapping)
    sizes = sorted((model.num_reg_images() for model in models.values()), reverse=True)
    log(f"COLMAP: {len(pairs)} pairs of {len(names)} keyframes; models of {sizes or 'no'} pictures")
    if not sizes or sizes[0] < options.least_keyframes:
        return None
    largest = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))
    camera = next(iter(largest.cameras.values()))
    radial = float(camera.params[3]) if intrinsics is None else 0.0
    return Structure(sparse_from_model(largest), camera.calibration_matrix(), radial, len(sizes))


def _telling(database: Path) -> float:
    """Return the share of matched pairs that only two different places explain."""
    places = (pycolmap.TwoViewGeometryConfiguration.CALIBRATED, pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED)
    with pycolmap.Database.open(database) as table:
        kinds = [geometry.config for geometry in table.read_two_view_geometries()[1]]
    return float(np.mean([pycolmap.TwoViewGeometryConfiguration(kind) in places for kind in kinds])) if kinds else 0.0


def _descriptors(database: Path, names: list[str]) -> list[UInt8[np.ndarray, "feature 128"]]:
    with pycolmap.Database.open(database) as table:
        images = {image.name: image.image_id for image in table.read_all_images()}
        return [np.asarray(table.read_descriptors(images[name]).data) for name in names]


def _pairs(descriptors: list[np.ndarray], options: StructureOptions, seed: int) -> Int[np.ndarray, "pair 2"]:
    """Pair each keyframe with its successors and with those that share the most words (weighted by rarity)."""
    count = len(descriptors)
    first, second = np.triu_indices(count, 1)
    chosen = second - first <= options.overlap
    alike = _likeness([np.sqrt(rows.astype(np.float32)) for rows in descriptors], options.words, seed)
    for key in range(count):
        others = np.argsort(-np.where(np.abs(np.arange(count) - key) <= options.overlap, -1.0, alike[key]), kind="stable")
        for other in others[: options.look_alikes]:
            if alike[key, other] > 0 and abs(other - key) > options.overlap:
                chosen |= (first == min(key, other)) & (second == max(key, other))
    return np.stack([first[chosen], second[chosen]], axis=1)


def _likeness(descriptors: list[np.ndarray], words: int, seed: int) -> Float[np.ndarray, "key key"]:
    """Return the cosine of the keyframes' word histograms, words weighted by their rarity (Sivic and Zisserman 2003)."""
    everything = np.concatenate(descriptors)
    sample = everything[np.random.default_rng(seed).permutation(len(everything))[: 40 * words]]
    if len(sample) < words:
        return np.zeros((len(descriptors), len(descriptors)))
    cv2.setRNGSeed(seed)
    centres = cv2.kmeans(sample, words, None, (cv2.TERM_CRITERIA_MAX_ITER, 8, 0), 1, cv2.KMEANS_PP_CENTERS)[2]
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    counts = np.stack([np.bincount([match.trainIdx for match in matcher.match(rows, centres)], minlength=words) for rows in descriptors])
    weighted = np.sqrt(counts) * np.log(len(counts) / np.maximum((counts > 0).sum(0), 1))
    weighted /= np.maximum(np.linalg.norm(weighted, axis=1, keepdims=True), 1e-9)
    return weighted @ weighted.T
