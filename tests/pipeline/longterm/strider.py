"""Synthetic data for long-term motion: a room with a block, and a four-legged body that walks without foot
skate.
"""

import numpy as np
import torch

from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh
from pipeline.longterm.bodies import SkinnedBody
from pipeline.longterm.config import LongTermSizes
from pipeline.longterm.contacts import find_contact_vertices
from pipeline.longterm.examples import MotionDataset, fit_pose_space
from pipeline.longterm.motion_synthesis import LongTerm, measure_motion_prior
from pipeline.longterm.networks import PoseNet, RouteNet, StaticBody
from pipeline.longterm.short_motions import RATE_HZ, BodyMotion
from pipeline.longterm.surroundings import MotionScene

HIP_M = 0.2
FEET = np.array([[0.06, -HIP_M, 0.12], [-0.06, -HIP_M, 0.12], [0.06, -HIP_M, -0.12], [-0.06, -HIP_M, -0.12]])
STRIDE_S = 0.6
SIZES = LongTermSizes(pose=12, latent=4, scene=16, hidden=8, width=16, points=32)


def box(low, high, outward=True) -> Mesh:
    """Return a closed box; inward-facing for a room."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    faces = np.array(
        [
            [0, 1, 3],
            [0, 3, 2],
            [4, 6, 7],
            [4, 7, 5],
            [0, 4, 5],
            [0, 5, 1],
            [2, 3, 7],
            [2, 7, 6],
            [0, 2, 6],
            [0, 6, 4],
            [1, 5, 7],
            [1, 7, 3],
        ]
    )
    return Mesh((low + corners * (high - low)).astype(np.float32), faces if outward else faces[:, ::-1])


def merged(*parts: Mesh) -> Mesh:
    """Merge meshes."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])
    return Mesh(np.concatenate([part.vertices for part in parts]), np.ascontiguousarray(faces, np.int32))


def room() -> Mesh:
    """Return a room of 4 x 2 x 4 m, floor at 0, with a block in its middle."""
    return merged(box([-2, 0, -2], [2, 2, 2], outward=False), box([-0.4, -0.1, -0.4], [0.4, 0.5, 0.4]))


def body() -> SkinnedBody:
    """Return a trunk and four legs of one bone each; soles are 0.2 m below the root."""
    parts = [box([-0.07, -0.05, -0.16], [0.07, 0.05, 0.16])]
    parts += [box(foot - [0.012, 0, 0.012], foot + np.array([0.012, HIP_M - 0.05, 0.012])) for foot in FEET]
    mesh = merged(*parts)
    weights = np.repeat(np.eye(5), 8, axis=0)
    rest = rigid.make(np.eye(3), np.concatenate([[np.zeros(3)], FEET]))
    return SkinnedBody(mesh, weights, rest, np.zeros(0))


def striding(way_world: np.ndarray, seconds: float) -> BodyMotion:
    """Walk along a polyline at constant speed; each foot is in stance for two thirds of every stride."""
    time_s = np.arange(round(seconds * RATE_HZ) + 1) / RATE_HZ
    root = _along(way_world, time_s, seconds)
    feet = np.stack(
        [_foot(way_world, time_s, seconds, foot, number) for number, foot in enumerate(FEET)], axis=1
    )
    in_agent = rigid.apply(rigid.inverse(root), feet)
    bones = np.tile(np.eye(4), (len(time_s), 5, 1, 1))
    bones[:, 1:, :3, 3] = in_agent
    return BodyMotion(root, bones)


def dataset(seed: int = 0, count: int = 3, seconds: float = 8.0) -> MotionDataset:
    """Return walks around the block."""
    rng = np.random.default_rng(seed)
    walks = []
    for _ in range(count):
        turn = rng.uniform(0, 2 * np.pi) + np.linspace(0, rng.choice([-1, 1]) * rng.uniform(2, 4), 12)
        walks.append(
            striding(np.column_stack([1.1 * np.sin(turn), np.zeros(12), 1.1 * np.cos(turn)]), seconds)
        )
    scene = MotionScene(room(), np.array([-2.1, -0.2, -2.1]), np.array([2.1, 0.8, 2.1]), voxel_m=0.05)
    return MotionDataset(body(), tuple(walks), (0,) * count, (scene,))


def untrained_model(data: MotionDataset) -> LongTerm:
    """Return networks of `SIZES` with random weights, and what is measured on the data."""
    torch.manual_seed(0)
    walks = list(data.stretches)
    poses = fit_pose_space(data.stretches, data.body.agent_from_bone_rest, SIZES.pose)
    contacts = find_contact_vertices(data.body, walks, data.distances)
    motion_prior = measure_motion_prior(walks, list(data.scenes) * len(walks))
    nets = (net.eval() for net in (StaticBody(SIZES), RouteNet(SIZES), PoseNet(SIZES)))
    return LongTerm(SIZES, poses, contacts, motion_prior, *nets)


def _along(way: np.ndarray, time_s: np.ndarray, seconds: float) -> np.ndarray:
    share = np.clip(time_s / seconds, 0, 1) * (len(way) - 1)
    index = np.arange(len(way))
    place = np.stack([np.interp(share, index, way[:, axis]) for axis in range(3)], axis=-1) + np.array(
        [0, HIP_M, 0]
    )
    ahead = np.stack(
        [np.interp(np.minimum(share + 0.3, len(way) - 1), index, way[:, axis]) for axis in range(3)], axis=-1
    )
    behind = np.stack(
        [np.interp(np.maximum(share - 0.3, 0), index, way[:, axis]) for axis in range(3)], axis=-1
    )
    yaw = np.arctan2(*(ahead - behind)[:, [0, 2]].T)
    turn = np.zeros((len(yaw), 3))
    turn[:, 1] = yaw
    return rigid.make(rigid.rotation_from_vector(turn), place)


def _foot(way: np.ndarray, time_s: np.ndarray, seconds: float, foot: np.ndarray, number: int) -> np.ndarray:
    stride = time_s / STRIDE_S + (0.0, 0.5, 0.5, 0.0)[number]
    index, share = np.floor(stride), stride % 1
    swing = np.clip((share - 0.67) / 0.33, 0, 1)
    places = [
        rigid.apply(
            _along(way, (index + k + 0.33 - (stride - time_s / STRIDE_S)) * STRIDE_S, seconds), foot[None]
        )[:, 0]
        for k in (0, 1)
    ]
    placed = places[0] + (swing * swing * (3 - 2 * swing))[:, None] * (places[1] - places[0])
    placed[:, 1] += 0.05 * 4 * swing * (1 - swing)
    return placed
