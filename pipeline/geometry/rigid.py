"""Rigid motions as 4x4 matrices in NumPy, always named ``a_from_b``.

Build them with `make` or `exp`, chain them with ``@``, move points with `apply`, undo with `inverse`.
Quaternions are wxyz with w >= 0; this file owns that order. Angles are radians, lengths meters.
"""

import itertools

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d, uniform_filter1d
from scipy.spatial.transform import Rotation, Slerp

PARALLEL = 1e-4
"""columns of a 6D rotation with a smaller perpendicular component are parallel"""
ANY_OTHER = np.array([0.3, 0.2, 0.1])
"""offset added to a permuted direction, so that it is never parallel to the original"""
CALM_SHARE = 0.2
"""of a sequence of poses, the calmest frames, whose variance is noise: animals rest, people stand"""


def make(
    rotation: Float[np.ndarray, "*#batch 3 3"], translation: Float[np.ndarray, "*#batch 3"]
) -> Float[np.ndarray, "*#batch 4 4"]:
    """Assemble transforms from rotations and translations, meters (broadcast over the batch)."""
    rotation, translation = np.asarray(rotation, float), np.asarray(translation, float)
    batch = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    a_from_b = np.zeros((*batch, 4, 4))
    a_from_b[..., :3, :3] = rotation
    a_from_b[..., :3, 3] = translation
    a_from_b[..., 3, 3] = 1.0
    return a_from_b


def inverse(a_from_b: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 4 4"]:
    """Invert transforms whose rotation part is orthonormal."""
    b_rotation_a = np.swapaxes(a_from_b[..., :3, :3], -1, -2)
    return make(b_rotation_a, -np.einsum("...ij,...j->...i", b_rotation_a, a_from_b[..., :3, 3]))


def apply(
    a_from_b: Float[np.ndarray, "*#batch 4 4"], points_b: Float[np.ndarray, "*#batch point 3"]
) -> Float[np.ndarray, "*#batch point 3"]:
    """Move points from frame b to frame a."""
    return points_b @ np.swapaxes(a_from_b[..., :3, :3], -1, -2) + a_from_b[..., None, :3, 3]


def rotation_from_vector(vector: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Turn rotation vectors (axis times angle, radians) into matrices: Rodrigues' formula."""
    vector = np.asarray(vector, float)
    return Rotation.from_rotvec(vector.reshape(-1, 3)).as_matrix().reshape(*vector.shape[:-1], 3, 3)


def vector_from_rotation(rotation: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Turn rotation matrices into rotation vectors of length <= pi, radians."""
    rotation = np.asarray(rotation, float)
    return Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_rotvec().reshape(*rotation.shape[:-2], 3)


def exp(twist: Float[np.ndarray, "*batch 6"]) -> Float[np.ndarray, "*batch 4 4"]:
    """Make a transform from (rotation vector in radians, translation in meters), decoupled: SO(3) x R^3."""
    return make(rotation_from_vector(twist[..., :3]), twist[..., 3:])


def log(a_from_b: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 6"]:
    """Undo `exp`."""
    return np.concatenate([vector_from_rotation(a_from_b[..., :3, :3]), a_from_b[..., :3, 3]], axis=-1)


def accumulate(
    steps: Float[np.ndarray, "step 4 4"], start: Float[np.ndarray, "4 4"] | None = None
) -> Float[np.ndarray, "pose 4 4"]:
    """Chain motions ``first_from_second`` to poses in the start's frame (default: the first one's)."""
    first = np.eye(4) if start is None else start
    return np.stack(list(itertools.accumulate(steps, np.matmul, initial=first)))


def yaw(a_from_b: Float[np.ndarray, "*batch _ _"]) -> Float[np.ndarray, "*batch"]:
    """Return the heading of b's +z axis about a's +y, radians from +z towards +x; transforms or rotations."""
    return np.arctan2(a_from_b[..., 0, 2], a_from_b[..., 2, 2])


def rotation_from_yaw(yaw_rad: Float[np.ndarray, "*batch"] | float) -> Float[np.ndarray, "*batch 3 3"]:
    """Return rotations about +y that take +z to a heading; undone by `yaw`."""
    return rotation_from_vector(np.asarray(yaw_rad)[..., None] * np.array([0.0, 1.0, 0.0]))


def wrap(angle_rad: Float[np.ndarray, "*any"] | float) -> Float[np.ndarray, "*any"]:
    """Bring angles to -pi..pi, radians."""
    return (np.asarray(angle_rad) + np.pi) % (2 * np.pi) - np.pi


def rotation_angle(
    first: Float[np.ndarray, "*#batch 3 3"], second: Float[np.ndarray, "*#batch 3 3"]
) -> Float[np.ndarray, "*#batch"]:
    """Return the geodesic angle between rotations, radians, exact at zero and at pi (atan2 form)."""
    relative = np.swapaxes(first, -1, -2) @ second
    axis = np.stack(
        [
            relative[..., 2, 1] - relative[..., 1, 2],
            relative[..., 0, 2] - relative[..., 2, 0],
            relative[..., 1, 0] - relative[..., 0, 1],
        ],
        -1,
    )
    return np.arctan2(np.linalg.norm(axis, axis=-1), np.trace(relative, axis1=-2, axis2=-1) - 1.0)


def quaternion_from_rotation(rotation: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 4"]:
    """Turn rotation matrices into unit quaternions wxyz with w >= 0."""
    rotation = np.asarray(rotation, float)
    xyzw = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_quat(canonical=True)
    return np.roll(xyzw, 1, axis=-1).reshape(*rotation.shape[:-2], 4)


def rotation_from_quaternion(quaternion: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Turn quaternions wxyz (any non-zero length) into rotation matrices."""
    quaternion = np.asarray(quaternion, float)
    xyzw = np.roll(quaternion.reshape(-1, 4), -1, axis=-1)
    return Rotation.from_quat(xyzw).as_matrix().reshape(*quaternion.shape[:-1], 3, 3)


def rotation_to_6d(rotation: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 6"]:
    """Return the first two columns, x axis, then y axis (Zhou et al. 2019)."""
    return np.concatenate([rotation[..., 0], rotation[..., 1]], axis=-1)


def rotation_from_6d(columns: Float[np.ndarray, "*batch 6"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Orthonormalize two columns into a rotation (Zhou et al. 2019, Eq. 15), parallel ones into any."""
    first = normalized(columns[..., :3])
    second = columns[..., 3:] - (first * columns[..., 3:]).sum(-1, keepdims=True) * first
    parallel = np.linalg.norm(second, axis=-1, keepdims=True) < PARALLEL
    second = normalized(np.where(parallel, np.cross(first, np.roll(first, 1, axis=-1) + ANY_OTHER), second))
    return np.stack([first, second, np.cross(first, second)], axis=-1)


def normalized(vector: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Scale vectors to unit length; zero stays zero."""
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True).clip(1e-9)


def interpolate(
    timestamp_s: Float[np.ndarray, "frame"],
    a_from_b: Float[np.ndarray, "frame 4 4"],
    query_s: Float[np.ndarray, "sample"],
) -> Float[np.ndarray, "sample 4 4"]:
    """Interpolate transforms in time: slerp for rotation, linear for translation, held beyond the ends."""
    if len(timestamp_s) == 1:
        return np.repeat(np.asarray(a_from_b, float), len(query_s), axis=0)
    query_s = np.clip(query_s, timestamp_s[0], timestamp_s[-1])
    rotation = Slerp(timestamp_s, Rotation.from_matrix(a_from_b[:, :3, :3]))(query_s).as_matrix()
    translation = np.stack(
        [np.interp(query_s, timestamp_s, a_from_b[:, axis, 3]) for axis in range(3)], axis=-1
    )
    return make(rotation, translation)


def interpolate_body(
    timestamp_s: Float[np.ndarray, "frame"], root: Float[np.ndarray, "frame 4 4"],
    bones: Float[np.ndarray, "frame bone 4 4"], query_s: Float[np.ndarray, "sample"],
) -> tuple[Float[np.ndarray, "sample 4 4"], Float[np.ndarray, "sample bone 4 4"]]:  # fmt: skip
    """Interpolate the root and the bones of a body in time, each as `interpolate` does."""
    tracks = [interpolate(timestamp_s, bone, query_s) for bone in np.moveaxis(bones, 1, 0)]
    return interpolate(timestamp_s, root, query_s), np.stack(tracks, axis=1)


def smoothed(a_from_b: Float[np.ndarray, "frame 4 4"], sigma_frames: float) -> Float[np.ndarray, "frame 4 4"]:
    """Smooth transforms in time: positions by a Gaussian, rotations by its chordal mean."""
    if sigma_frames <= 0:
        return a_from_b
    mean = gaussian_filter1d(a_from_b[:, :3], sigma_frames, axis=0, mode="nearest")
    return make(nearest_rotation(mean[:, :, :3]), mean[:, :, 3])


def wiener_filter(
    poses: Float[np.ndarray, "frame *pose 4 4"], known: Bool[np.ndarray, "frame"], window: int
) -> Float[np.ndarray, "frame *pose 4 4"]:
    """Filter each sequence of poses, rotation and translation by themselves (Lee 1980).

    A pose is moved to the mean over ``window`` frames, by as much of its deviation as noise explains: all of
    it where the local variance is that of noise, hardly any in fast motion. Noise is the `CALM_SHARE`
    quantile of the local variance of ``known`` frames. With fewer of them than the window, poses are returned
    unchanged.
    """
    if known.sum() < window:
        return poses
    mean = uniform_filter1d(poses, window, axis=0, mode="nearest")
    mean[..., :3, :3] = nearest_rotation(mean[..., :3, :3])
    turned = np.swapaxes(mean[..., :3, :3], -1, -2) @ poses[..., :3, :3]
    shift = poses[..., :3, 3] - mean[..., :3, 3]
    turn = _signal(log(make(turned, shift))[..., :3], known, window)
    moved = exp(np.concatenate([turn, _signal(shift, known, window)], axis=-1))
    rotation = mean[..., :3, :3] @ moved[..., :3, :3]
    return make(rotation, mean[..., :3, 3] + moved[..., :3, 3])


def _signal(
    deviation: Float[np.ndarray, "frame *pose 3"], known: Bool[np.ndarray, "frame"], window: int
) -> Float[np.ndarray, "frame *pose 3"]:
    """Return the part of deviations that is not noise."""
    variance = uniform_filter1d(np.square(deviation).sum(-1), window, axis=0, mode="nearest")
    noise = np.quantile(variance[known], CALM_SHARE, axis=0)
    share = 1 - noise / np.maximum(variance, np.maximum(noise, np.finfo(float).tiny))
    return share[..., None] * deviation


def nearest_rotation(matrix: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Return the nearest rotation to each matrix, by its singular vectors."""
    left, _, right = np.linalg.svd(matrix)
    left[..., 2] *= np.sign(np.linalg.det(left @ right))[..., None]
    return left @ right


def mean_rotation(
    rotation: Float[np.ndarray, "sample 3 3"], weights: Float[np.ndarray, "sample"] | None = None
) -> Float[np.ndarray, "3 3"]:
    """Return the weighted chordal mean of rotations."""
    return Rotation.from_matrix(rotation).mean(weights).as_matrix()


def look_at(
    eye: Float[np.ndarray, "*#batch 3"], target: Float[np.ndarray, "*#batch 3"], up: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "*batch 4 4"]:
    """Return ``world_from_camera`` (OpenCV axes) of upright cameras at ``eye`` that look at ``target``.

    No target may be straight above or below its camera.
    """
    forward = normalized(np.asarray(target, float) - eye)
    right = normalized(np.cross(forward, up))
    return make(np.stack([right, np.cross(forward, right), forward], axis=-1), np.asarray(eye, float))
