"""Root and bone poses from motion capture joint positions, for any skeleton.

Nobody says which joint hangs on which: joints that keep their distance are joined (a minimum spanning tree
over how much distances vary), and each joint's bone points to its neighbor away from the root.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from pipeline.geometry import rigid
from stages.read_trajectories.config import Config


def parents(joints: Float[np.ndarray, "frame joint 3"], root: int) -> Int[np.ndarray, "joint"]:
    """Return the parent of each joint; -1 for the root."""
    distance = np.linalg.norm(joints[::7, :, None] - joints[::7, None], axis=-1)
    cost = distance.std(0) + 1e-3 * distance.mean(0) + 1e-9
    tree = minimum_spanning_tree(csr_array(np.triu(cost, 1)))
    _, before = breadth_first_order(tree, root, directed=False)
    return np.where(before < 0, -1, before)


def root_from_joints(
    joints: Float[np.ndarray, "frame joint 3"], config: Config
) -> Float[np.ndarray, "frame 4 4"]:
    """Return ``world_from_agent``: origin at the root joint, +z to the front joint, +y closest to up."""
    forward = joints[:, config.front_joint] - joints[:, config.root_joint]
    forward = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    side = np.cross([0.0, 1.0, 0.0], forward)
    side = side / np.linalg.norm(side, axis=-1, keepdims=True)
    return rigid.make(
        np.stack([side, np.cross(forward, side), forward], axis=-1), joints[:, config.root_joint]
    )


def bones_from_joints(
    joints_agent: Float[np.ndarray, "frame joint 3"], parent: Int[np.ndarray, "joint"]
) -> tuple[Float[np.ndarray, "frame joint 4 4"], Float[np.ndarray, "joint 4 4"]]:
    """Return ``agent_from_bone`` and its rest pose, one bone per joint, relative to its mean direction."""
    child = np.array(
        [next((c for c in range(len(parent)) if parent[c] == j), -1) for j in range(len(parent))]
    )
    other = np.where(child >= 0, child, parent)
    direction = rigid.normalized(joints_agent[:, other] - joints_agent)
    rest = np.tile(np.eye(4), (len(parent), 1, 1))
    rest[:, :3, 3] = np.median(joints_agent, axis=0)
    return rigid.make(_shortest_turn(rigid.normalized(direction.mean(0)), direction), joints_agent), rest


def _shortest_turn(
    start: Float[np.ndarray, "joint 3"], end: Float[np.ndarray, "frame joint 3"]
) -> Float[np.ndarray, "frame joint 3 3"]:
    """Return the smallest rotations from ``start`` to ``end``; identity for directions of length 0."""
    start = np.broadcast_to(start, end.shape)
    axis = np.cross(start, end)
    angle = np.arctan2(np.linalg.norm(axis, axis=-1), (start * end).sum(-1))
    known = np.linalg.norm(end, axis=-1) > 0.5
    return rigid.rotation_from_vector(rigid.normalized(axis) * np.where(known, angle, 0.0)[..., None])
