"""MuJoCo: one mocap body per bone with the animal's skin bound to them, and the room as boxes.

`motions.npz` holds the keys of `data.mocap_pos` and `data.mocap_quat` for each motion.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.adapters.live_animal import ZUP_FROM_WORLD
from pipeline.behavior.perception import FeatureVolume
from pipeline.data import npz
from pipeline.geometry import rigid
from stages.export.reading import Agent
from stages.export.writing import ExportRecord, extra, version

GRAY = 150
"""of an animal without colors, 0..255"""


def write(folder: Path, agent: Agent, volume: FeatureVolume) -> ExportRecord:
    """Write `agent.xml` (z up, as MuJoCo has it) and `motions.npz`; compile the model and pose it."""
    mujoco = extra("mujoco", "mujoco")
    motions, poses = {}, []
    for action in agent.actions:
        poses.append(ZUP_FROM_WORLD @ action.world_from_agent[:, None] @ action.agent_from_bone)
        motions[f"{action.name}/time_s"] = action.time_s
        motions[f"{action.name}/mocap_pos"] = poses[-1][..., :3, 3]
        motions[f"{action.name}/mocap_quat"] = rigid.quaternion_from_rotation(poses[-1][..., :3, :3])
    (folder / "agent.xml").write_text(model(agent, poses[0][0], boxes(volume.occupancy == 1), volume))
    npz.save(folder / "motions.npz", **motions)
    loss = agent.loss_mm
    loss["bodies"] = round(1000 * _posed(mujoco, folder / "agent.xml", motions, agent.actions[0].name), 4)
    loss["room_voxel"] = 1000 * volume.voxel_m
    driven = "drive data.mocap_pos and data.mocap_quat with motions.npz"
    remark = f"meters, +z up; {driven}; the room's boxes are as coarse as its voxels"
    return ExportRecord(version("mujoco"), loss, version("mujoco"), remark)


def boxes(solid: Bool[np.ndarray, "x y z"]) -> Int[np.ndarray, "box 2 3"]:
    """Cover solid voxels greedily by few disjoint boxes: lowest and highest voxel (exclusive) of each."""
    left, found = solid.copy(), []
    while left.any():
        low = np.array(np.unravel_index(left.argmax(), left.shape))
        high = low + 1
        for axis in (2, 1, 0):
            while high[axis] < left.shape[axis]:
                slab = [slice(*pair) for pair in zip(low, high, strict=True)]
                slab[axis] = slice(high[axis], high[axis] + 1)
                if not left[tuple(slab)].all():
                    break
                high[axis] += 1
        left[tuple(slice(*pair) for pair in zip(low, high, strict=True))] = False
        found.append([low, high])
    return np.array(found, int).reshape(-1, 2, 3)


def model(
    agent: Agent,
    zup_from_bone: Float[np.ndarray, "bone 4 4"],
    room: Int[np.ndarray, "box 2 3"],
    volume: FeatureVolume,
) -> str:
    """Return the MJCF text; the skin's bones are bound at rest."""
    bodies, bones = [], []
    turns = rigid.quaternion_from_rotation(zup_from_bone[:, :3, :3])
    rest = agent.skin.agent_from_bone_rest
    rest_turns = rigid.quaternion_from_rotation(rest[:, :3, :3])
    for bone, name in enumerate(agent.skin.bone_names):
        place, turn = _row(zup_from_bone[bone, :3, 3]), _row(turns[bone])
        bodies.append(
            f'<body name="{name}" mocap="true" pos="{place}" quat="{turn}">'
            '<geom type="sphere" size="0.02" contype="0" conaffinity="0" group="4"/></body>'
        )
        weight = np.where(agent.skin.joints == bone, agent.skin.weights, 0).sum(1)
        moved = np.flatnonzero(weight > 0)
        if len(moved):
            bound = f'bindpos="{_row(rest[bone, :3, 3])}" bindquat="{_row(rest_turns[bone])}"'
            vertices = " ".join(map(str, moved))
            moving = f'vertid="{vertices}" vertweight="{_row(weight[moved])}"'
            bones.append(f'<bone body="{name}" {bound} {moving}/>')
    vertices, faces = _row(agent.mesh.vertices.ravel()), " ".join(map(str, agent.mesh.faces.ravel()))
    color = _row((np.full(3, GRAY) if agent.mesh.color is None else agent.mesh.color.mean(0)) / 255)
    lines = [
        '<mujoco model="agent">',
        '<visual><headlight ambient="0.4 0.4 0.4"/></visual>',
        f'<deformable><skin name="agent" rgba="{color} 1" vertex="{vertices}" face="{faces}">',
        *(*bones, "</skin></deformable>"),
        *("<worldbody>", *_room(room, volume), *bodies, "</worldbody>"),
        *("</mujoco>", ""),
    ]
    return "\n".join(lines)


def _room(room: Int[np.ndarray, "box 2 3"], volume: FeatureVolume) -> list[str]:
    lines = []
    for low, high in room:
        middle = volume.origin + (low + high) / 2 * volume.voxel_m
        half = (high - low) / 2 * volume.voxel_m
        place, size = _row(ZUP_FROM_WORLD[:3, :3] @ middle), _row(half[[0, 2, 1]])
        lines.append(f'<geom type="box" pos="{place}" size="{size}" rgba="0.8 0.78 0.74 1"/>')
    return lines


def _posed(mujoco: Any, path: Path, motions: dict[str, np.ndarray], name: str) -> float:
    """Compile the file, pose it, and return the largest error of body positions, meters."""
    compiled = mujoco.MjModel.from_xml_path(str(path))
    assert compiled.nskin == 1, "the animal's skin"
    data = mujoco.MjData(compiled)
    frame = len(motions[f"{name}/time_s"]) // 2
    places = motions[f"{name}/mocap_pos"][frame]
    data.mocap_pos[:], data.mocap_quat[:] = places, motions[f"{name}/mocap_quat"][frame]
    mujoco.mj_forward(compiled, data)
    bodies = [compiled.body(body).id for body in range(compiled.nbody) if compiled.body(body).mocapid[0] >= 0]
    return float(np.linalg.norm(data.xpos[bodies] - places, axis=1).max())


def _row(values: Float[np.ndarray, " n"]) -> str:
    return " ".join(f"{value:.6g}" for value in values)
