"""Compare dense descriptors that need no downloaded weights by the matching accuracy between two views.

    python -m benchmarks.descriptors build/cat --rgbd 7scenes/kitchen --pairs 24

Pairs of overlapping views differ by 5 to 45 degrees: from a folder of RGB-D frames with poses (7-Scenes), unchanged
and with the second view relit, and from different sessions of a finished build, whose light differs. The true match
of a cell follows from depth and poses; it is found if the nearest neighbor among all cells of the other picture lies
within one cell of it. Each descriptor is evaluated raw and reduced to the 16 channels that all stages use.
"""

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import scipy.ndimage
import torch
from jaxtyping import Float, UInt8

from benchmarks import command_lines
from pipeline.backends import daisy
from pipeline.data import npz
from pipeline.data.clips import Clip
from pipeline.geometry import cameras, rigid

STRIDE_PX = 8
WINDOW_PX = 36
"""side of the support region of a descriptor, pixels of the reduced picture; that of DAISY"""
SURFACE_M = 0.05
"""tolerance within which two depths show the same surface"""
MIN_CELLS = 150
Describe = Callable[[UInt8[np.ndarray, "height width 3"], int], Float[np.ndarray, "rows columns channel"]]


@dataclass(frozen=True)
class View:
    """A picture with its depth (meters, 0 unknown) and its camera."""

    color: UInt8[np.ndarray, "height width 3"]
    depth: Float[np.ndarray, "height width"]
    intrinsics: Float[np.ndarray, "3 3"]
    """of the color picture"""
    world_from_camera: Float[np.ndarray, "4 4"]

    def depth_at(self, pixel: Float[np.ndarray, "point 2"]) -> Float[np.ndarray, "point"]:
        """Read the depth at color pixels; 0 outside."""
        size, inner = np.array(self.color.shape[1::-1]), np.array(self.depth.shape[::-1])
        inside = ((pixel >= 0) & (pixel < size)).all(-1)
        at = np.where(inside[:, None], pixel * inner / size, 0).astype(int)
        return np.where(inside, self.depth[at[:, 1], at[:, 0]], 0)


def rgbd_views(folder: Path) -> list[View]:
    """Read frames in the 7-Scenes format; color and depth share one camera."""
    intrinsics, found = np.loadtxt(folder / "camera-intrinsics.txt"), []
    for path in sorted(folder.glob("frame-*.pose.txt")):
        name = path.name.removesuffix(".pose.txt")
        color = next(folder.glob(f"{name}.color.*"))
        depth = cv2.imread(str(folder / f"{name}.depth.png"), cv2.IMREAD_UNCHANGED) / np.float32(1000)
        picture = cv2.cvtColor(cv2.imread(str(color)), cv2.COLOR_BGR2RGB)
        found.append(View(picture, np.where(depth < 10, depth, 0), intrinsics, np.loadtxt(path)))
    return found


def session_views(build: Path, per_session: int) -> list[list[View]]:
    """Read some frames of each registered session, with their registered poses."""
    sessions = []
    for path in sorted(build.glob("registration/*/poses.npz")):
        clip = Clip.open(build / "frames" / path.parent.name)
        poses = npz.load(path, ("world_from_camera",))["world_from_camera"]
        chosen = np.linspace(0, len(clip) - 1, per_session).astype(int).tolist()
        sessions.append(
            [
                View(clip.color(i), clip.depth(i), clip.intrinsics[i], poses[i])
                for i in chosen
                if np.isfinite(poses[i]).all()
            ]
        )
    return sessions


def relit(view: View) -> View:
    """Return the view relit as at dusk: darker, with less contrast, yellower, with noise."""
    noise = np.random.default_rng(0).normal(0, 3, view.color.shape)
    color = 255 * (view.color / 255) ** 1.4 * [0.6, 0.5, 0.35] + 12 + noise
    return replace(view, color=np.clip(np.round(color), 0, 255).astype(np.uint8))


@dataclass(frozen=True)
class Pair:
    """Two views and, for cells of the first, the pixels of the second that show the same surface."""

    first: View
    second: View
    cell: Float[np.ndarray, "cell"]
    """index of the cell, rows by columns"""
    match_px: Float[np.ndarray, "cell 2"]


def match_cells(first: View, second: View) -> Pair | None:
    """Find the true matches; None where the rotation between the views is too small or too large, or the overlap too small."""
    angle_deg = np.degrees(
        rigid.rotation_angle(first.world_from_camera[:3, :3], second.world_from_camera[:3, :3])
    )
    if not 5 < angle_deg < 45:
        return None
    rows, columns = (side // STRIDE_PX for side in first.color.shape[:2])
    pixel = ((cameras.pixel_grid(rows, columns)) * STRIDE_PX).reshape(-1, 2)
    z = first.depth_at(pixel)
    world = rigid.apply(first.world_from_camera, cameras.unproject(pixel, first.intrinsics) * z[:, None])
    target, distance = cameras.project(
        rigid.apply(rigid.inverse(second.world_from_camera), world), second.intrinsics
    )
    seen = (z > 0) & (distance > 0.1)
    seen &= np.abs(second.depth_at(np.where(seen[:, None], target, -1)) - distance) < SURFACE_M
    return Pair(first, second, np.flatnonzero(seen), target[seen]) if seen.sum() >= MIN_CELLS else None


def draw_pairs(
    candidates: Callable[[np.random.Generator], tuple[View, View]], count: int, tries: int = 2000
) -> list[Pair]:
    """Draw candidates until ``count`` pairs are found."""
    rng, found = np.random.default_rng(0), []
    for _ in range(tries):
        pair = match_cells(*candidates(rng))
        if pair is not None:
            found.append(pair)
        if len(found) == count:
            break
    return found


def dense_sift(
    color: UInt8[np.ndarray, "height width 3"], stride_px: int
) -> Float[np.ndarray, "rows columns channel"]:
    """Upright SIFT (Lowe 2004) at every cell, square-rooted (Arandjelovic and Zisserman 2012)."""
    gray, points, shape = _keypoint_grid(color, stride_px, WINDOW_PX / 6)
    raw = cv2.SIFT.create().compute(gray, points)[1]
    return np.sqrt(raw / np.maximum(raw.sum(1, keepdims=True), 1e-6)).reshape(*shape, -1)


def dense_vgg(
    color: UInt8[np.ndarray, "height width 3"], stride_px: int
) -> Float[np.ndarray, "rows columns channel"]:
    """Descriptors learned by convex optimization (Simonyan et al. 2014), shipped with opencv-contrib."""
    gray, points, shape = _keypoint_grid(color, stride_px, WINDOW_PX / 6.25)
    raw = cv2.xfeatures2d.VGG.create().compute(gray, points)[1]
    return _unit(raw).reshape(*shape, -1)


def dense_kernels(
    color: UInt8[np.ndarray, "height width 3"], stride_px: int, patch: int = 32
) -> Float[np.ndarray, "rows columns channel"]:
    """Multiple kernel descriptors (Mukundan et al. 2019) of kornia, without its learned whitening."""
    from kornia.feature import MKDDescriptor

    gray, points, shape = _keypoint_grid(color, stride_px, WINDOW_PX)
    offset = ((np.arange(patch) + 0.5) / patch - 0.5) * WINDOW_PX
    at = np.array([point.pt for point in points], np.float32)
    x, y = np.broadcast_arrays(
        at[:, :1, None] + offset[None, None, :], at[:, 1:, None] + offset[None, :, None]
    )
    patches = scipy.ndimage.map_coordinates(gray.astype(np.float32), [y, x], order=1)
    with torch.inference_mode():
        network = MKDDescriptor(patch_size=patch, kernel_type="concat", whitening=None)
        raw = network(torch.from_numpy(patches[:, None]) / 255).numpy()
    return _unit(np.nan_to_num(raw)).reshape(*shape, -1)


DESCRIPTORS: dict[str, Describe] = {
    "daisy": daisy.describe,
    "sift": dense_sift,
    "vgg": dense_vgg,
    "kernels": dense_kernels,
}


def matching_accuracy(sets: dict[str, list[Pair]], describe: Describe) -> Iterator[tuple[str, float, float]]:
    """Yield (set, accuracy of raw descriptors, accuracy with 16 channels); the basis is fitted to all pictures of all sets."""
    views = {
        id(view): view for pairs in sets.values() for pair in pairs for view in (pair.first, pair.second)
    }
    raw = {key: describe(view.color, STRIDE_PX) for key, view in views.items()}
    basis = daisy.fit_basis(
        np.concatenate([d.reshape(-1, d.shape[-1])[::4] for d in raw.values()]), whitening=0.5
    )
    for name, pairs in sets.items():
        shares = [
            np.mean(
                [
                    _accuracy(pair, project(raw[id(pair.first)]), project(raw[id(pair.second)]))
                    for pair in pairs
                ]
            )
            for project in (lambda d: d, basis.project)
        ]
        yield name, float(shares[0]), float(shares[1])


def _accuracy(
    pair: Pair,
    first: Float[np.ndarray, "rows columns channel"],
    second: Float[np.ndarray, "rows columns channel"],
) -> float:
    """Return the fraction of cells whose nearest neighbor is within one cell of the true match."""
    nearest = (first.reshape(-1, first.shape[-1])[pair.cell] @ second.reshape(-1, second.shape[-1]).T).argmax(
        1
    )
    row, column = np.divmod(nearest, second.shape[1])
    found_px = (np.stack([column, row], -1) + 0.5) * STRIDE_PX
    return float((np.abs(found_px - pair.match_px).max(-1) < 1.5 * STRIDE_PX).mean())


def _keypoint_grid(
    color: np.ndarray, stride_px: int, size: float
) -> tuple[np.ndarray, list[cv2.KeyPoint], tuple[int, int]]:
    """Return the reduced picture with reflected borders, a key point per cell, and the shape of the grid."""
    gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    scale = min(1.0, daisy.WORKING_SIDE_PX / max(gray.shape))
    gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else gray
    rows, columns = (side // stride_px for side in color.shape[:2])
    gray = cv2.copyMakeBorder(gray, *4 * (daisy.MARGIN_PX,), cv2.BORDER_REFLECT_101)
    y, x = ((np.arange(count) + 0.5) * stride_px * scale - 0.5 + daisy.MARGIN_PX for count in (rows, columns))
    return (
        gray,
        [cv2.KeyPoint(float(column), float(row), size, 0.0) for row in y for column in x],
        (rows, columns),
    )


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-6)


def main() -> None:
    """Print one line per descriptor and set."""
    parser = command_lines.described(__doc__)
    parser.add_argument("build", type=Path, help="a build with a finished registration")
    parser.add_argument("--rgbd", type=Path, help="a folder of frames in the 7-Scenes format")
    parser.add_argument("--pairs", type=int, default=24, help="pairs of views per set")
    parser.add_argument("--descriptors", nargs="+", choices=DESCRIPTORS, default=list(DESCRIPTORS))
    arguments = parser.parse_args()
    sessions, sets = session_views(arguments.build, 12), {}
    if arguments.rgbd:
        views = rgbd_views(arguments.rgbd)
        sets["rgbd"] = draw_pairs(
            lambda rng: tuple(views[i] for i in rng.choice(len(views), 2, replace=False)), arguments.pairs
        )
        sets["rgbd, relit"] = [replace(pair, second=relit(pair.second)) for pair in sets["rgbd"]]

    def of_two_sessions(rng: np.random.Generator) -> tuple[View, View]:
        one, other = rng.choice(len(sessions), 2, replace=False)
        return sessions[one][rng.integers(len(sessions[one]))], sessions[other][
            rng.integers(len(sessions[other]))
        ]

    sets["between sessions"] = draw_pairs(of_two_sessions, arguments.pairs)
    for name, describe in ((name, DESCRIPTORS[name]) for name in arguments.descriptors):
        start = time.process_time()
        shares = {
            part: [round(raw, 3), round(reduced, 3)]
            for part, raw, reduced in matching_accuracy(sets, describe)
        }
        counts = {part: len(pairs) for part, pairs in sets.items()}
        print(
            json.dumps(
                {
                    "descriptor": name,
                    "raw, 16 channels": shares,
                    "pairs": counts,
                    "cpu_s": round(time.process_time() - start, 1),
                }
            )
        )


if __name__ == "__main__":
    main()
