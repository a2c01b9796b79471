"""Rigid motions in PyTorch: differentiable, batched, safe gradients at the identity.

The mirror of `pipeline.geometry.rigid` for code that is optimized. Quaternions are wxyz, as in kornia.
"""

import torch
from jaxtyping import Float
from kornia.geometry import conversions
from torch import Tensor


def so3_exp(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Turn rotation vectors (radians) into matrices: Rodrigues' formula, near zero its Taylor series."""
    return conversions.axis_angle_to_rotation_matrix(vector)


def make(
    rotation: Float[Tensor, "*#batch 3 3"], translation: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*#batch 4 4"]:
    """Assemble transforms from rotations and translations, meters."""
    top = torch.cat([rotation, translation[..., None]], dim=-1)
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=rotation.dtype, device=rotation.device).expand(
        *top.shape[:-2], 1, 4
    )
    return torch.cat([top, bottom], dim=-2)


def se3_exp(twist: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 4 4"]:
    """Make transforms from (rotation vector, translation), decoupled as in `pipeline.geometry.rigid.exp`."""
    return make(so3_exp(twist[..., :3]), twist[..., 3:])


def inverse(a_from_b: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Invert transforms whose rotation part is orthonormal."""
    b_rotation_a = a_from_b[..., :3, :3].transpose(-1, -2)
    return make(b_rotation_a, -(b_rotation_a @ a_from_b[..., :3, 3:])[..., 0])


def apply(
    a_from_b: Float[Tensor, "*#batch 4 4"], points_b: Float[Tensor, "*#batch point 3"]
) -> Float[Tensor, "*#batch point 3"]:
    """Move points from frame b to frame a."""
    return points_b @ a_from_b[..., :3, :3].transpose(-1, -2) + a_from_b[..., None, :3, 3]


def rotation_from_quaternion(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Turn quaternions wxyz of any non-zero length into rotation matrices."""
    return conversions.quaternion_to_rotation_matrix(quaternion)


def quaternion_from_rotation(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Turn rotation matrices into unit quaternions wxyz with w >= 0."""
    quaternion = torch.nn.functional.normalize(conversions.rotation_matrix_to_quaternion(rotation), dim=-1)
    return torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def rotation_from_6d(columns: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 3 3"]:
    """Orthonormalize two columns into a rotation (Zhou et al. 2019, Eq. 15)."""
    first = torch.nn.functional.normalize(columns[..., :3], dim=-1)
    second = columns[..., 3:] - (first * columns[..., 3:]).sum(-1, keepdim=True) * first
    second = torch.nn.functional.normalize(second, dim=-1)
    return torch.stack([first, second, torch.linalg.cross(first, second)], dim=-1)


def rotation_to_6d(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 6"]:
    """Return the first two columns of rotations (Zhou et al. 2019); undone by `rotation_from_6d`."""
    return torch.cat([rotation[..., 0], rotation[..., 1]], dim=-1)
