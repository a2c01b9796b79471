"""BVH files: a flat hierarchy of bones with six channels per joint, exact; read back to measure the loss."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from pipeline.data.glb import Action
from pipeline.geometry import rigid
from stages.export.reading import Agent
from stages.export.writing import ExportRecord

_ORDER = "ZXY"
_ROOT_CHANNELS = "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"
_END_SITE = ("End Site", "{", "OFFSET 0 0 0.02", "}")


def write(folder: Path, agent: Agent) -> ExportRecord:
    """Write `<motion>.flat.bvh` for every motion."""
    names, lost = list(agent.skin.bone_names), []
    for action in agent.actions:
        file = folder / f"{action.name}.flat.bvh"
        file.write_text(flat(action, names, agent.rate_hz))
        truth = (action.world_from_agent[:, None] @ action.agent_from_bone)[..., :3, 3]
        lost.append(read_places(file, names) - truth)
    lost_mm = 1000 * np.linalg.norm(np.concatenate(lost), axis=-1)
    measured = {"flat_mean": round(float(lost_mm.mean()), 4), "flat_max": round(float(lost_mm.max()), 4)}
    remark = "meters, +y up, rotations in the order Z X Y; give 1.0 as the scale; distances of bones' centers"
    loss = agent.retargeting_loss_mm | measured
    return ExportRecord("own writer", loss, "own reader, with forward kinematics", remark)


def flat(action: Action, names: list[str], rate_hz: float) -> str:
    """Return BVH text with every bone a child of the root with six channels: lossless."""
    lines = ["HIERARCHY", "ROOT agent", "{", "OFFSET 0 0 0", _ROOT_CHANNELS]
    for name in names:
        lines += [f"JOINT {name}", "{", "OFFSET 0 0 0", _ROOT_CHANNELS, *_END_SITE, "}"]
    poses = np.concatenate([action.world_from_agent[:, None], action.agent_from_bone], 1)
    angles = Rotation.from_matrix(poses[..., :3, :3].reshape(-1, 3, 3)).as_euler(_ORDER, degrees=True)
    channels = np.concatenate([poses[..., :3, 3], angles.reshape(*poses.shape[:2], 3)], -1)
    rows = [" ".join(f"{value:.6f}" for value in row) for row in channels.reshape(len(poses), -1)]
    head = [*lines, "}", "MOTION", f"Frames: {len(rows)}", f"Frame Time: {1 / rate_hz:.8f}"]
    return "\n".join([*head, *rows, ""])


def read_places(path: Path, names: list[str]) -> Float[np.ndarray, "frame joint 3"]:
    """Read a file by forward kinematics and return the positions of the named joints, meters."""
    head, _, body = path.read_text().partition("MOTION")
    rows = np.array([[float(value) for value in line.split()] for line in body.strip().splitlines()[2:]])
    stack: list[np.ndarray] = []
    places: dict[str, np.ndarray] = {}
    name, offset, column = "", np.zeros(3), 0
    for line in head.splitlines()[1:]:
        word, *rest = line.split()
        match word:
            case "ROOT" | "JOINT" | "End":
                name = rest[0]
            case "OFFSET":
                offset = np.array(rest, float)
                parent = stack[-1] if stack else np.broadcast_to(np.eye(4), (len(rows), 4, 4))
                stack.append(parent @ rigid.make(np.eye(3), offset))
                places.setdefault(name, stack[-1][:, :3, 3])
            case "CHANNELS":  # six
                values, column = rows[:, column : column + 6], column + 6
                turn = Rotation.from_euler(_ORDER, values[:, 3:], degrees=True).as_matrix()
                stack[-1] = stack[-1] @ rigid.make(turn, values[:, :3])
                places[name] = stack[-1][:, :3, 3]
            case "}":
                stack.pop()
    return np.stack([places[joint] for joint in names], 1)
