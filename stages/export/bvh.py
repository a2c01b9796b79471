"""BVH files: a flat hierarchy (six channels per joint, exact), and a fitted tree (rotations about pivots).

The pivot of two bones is the point that moves most alike with both over all motions (least squares); the tree
is the minimum spanning tree over the residuals. Its loss is reported.
"""

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial.transform import Rotation

from pipeline.data.glb import Action
from pipeline.geometry import rigid, subsampling
from stages.export.reading import Agent
from stages.export.writing import ExportRecord

_ORDER = "ZXY"
_ROOT_CHANNELS = "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"
_ROTATION_CHANNELS = "CHANNELS 3 Zrotation Xrotation Yrotation"
_END_SITE = ("End Site", "{", "OFFSET 0 0 0.02", "}")
_PULL_TO_MIDDLE = 1e-4
_FITTED_FRAMES = 400


@dataclass(frozen=True)
class Tree:
    """Bones joined at pivots; the first in `order` is the root, each other comes after its parent."""

    parent: list[int]
    """-1 for the root"""
    order: list[int]
    pivot_agent: Float[np.ndarray, "bone 3"]
    """at rest, agent frame"""


def write(folder: Path, agent: Agent) -> ExportRecord:
    """Write `<motion>.flat.bvh` and `<motion>.tree.bvh` for every motion."""
    rest, names = agent.skin.agent_from_bone_rest, list(agent.skin.bone_names)
    recorded = np.concatenate([action.agent_from_bone for action in agent.actions])
    chosen = subsampling.evenly(len(recorded), _FITTED_FRAMES)
    tree = fit_tree(recorded[chosen] @ rigid.inverse(rest), rest)
    exact, lost = [], []
    for action in agent.actions:
        flat_file, tree_file = (folder / f"{action.name}.{kind}.bvh" for kind in ("flat", "tree"))
        flat_file.write_text(flat(action, names))
        tree_file.write_text(hierarchical(action, tree, rest, names))
        truth = (action.world_from_agent[:, None] @ action.agent_from_bone)[..., :3, 3]
        exact.append(read_places(flat_file, names) - truth)
        lost.append(read_places(tree_file, [f"{name}_centre" for name in names]) - truth)
    loss: dict[str, float] = dict(agent.retargeting_loss_mm)
    for kind, apart in (("flat", exact), ("tree", lost)):
        apart_mm = 1000 * np.linalg.norm(np.concatenate(apart), axis=-1)
        loss[f"{kind}_mean"] = round(float(apart_mm.mean()), 4)
        loss[f"{kind}_max"] = round(float(apart_mm.max()), 4)
    remark = "metres, +y up, rotations in the order Z X Y; give 1.0 as the scale; distances of bones' centres"
    return ExportRecord("own writer", loss, "own reader, with forward kinematics", remark)


def fit_tree(
    posed_from_rest: Float[np.ndarray, "frame bone 4 4"], rest: Float[np.ndarray, "bone 4 4"]
) -> Tree:
    """Fit pivots, and the tree with the smallest residuals at its joints."""
    count = posed_from_rest.shape[1]
    pivots, gap = np.zeros((count, count, 3)), np.zeros((count, count))
    for first, second in itertools.combinations(range(count), 2):
        moved = posed_from_rest[:, first], posed_from_rest[:, second]
        pivots[first, second], gap[first, second] = _pivot(*moved, rest[[first, second]])
    links = minimum_spanning_tree(gap)
    root = int(np.linalg.norm(rest[:, :3, 3], axis=1).argmin())
    order, before = breadth_first_order(links, root, directed=False)
    parent = [int(before[bone]) if bone != root else -1 for bone in range(count)]
    pivot = np.stack([pivots[min(pair), max(pair)] for pair in enumerate(parent)])
    pivot[root] = rest[root, :3, 3]
    return Tree(parent, order.tolist(), pivot)


def _pivot(first: np.ndarray, second: np.ndarray, rest: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the pivot of two moving bones at rest, and its mean squared residual, metres²."""
    turn, shift = first[:, :3, :3] - second[:, :3, :3], first[:, :3, 3] - second[:, :3, 3]
    middle = rest[:, :3, 3].mean(0)
    gram = np.einsum("fki,fkj->ij", turn, turn) / len(turn) + _PULL_TO_MIDDLE * np.eye(3)
    pivot = np.linalg.solve(gram, _PULL_TO_MIDDLE * middle - np.einsum("fki,fk->i", turn, shift) / len(turn))
    apart = turn @ pivot + shift
    nearness = ((rest[0, :3, 3] - rest[1, :3, 3]) ** 2).sum()
    return pivot, float((apart**2).sum(1).mean() + 1e-3 * nearness + 1e-12)


def flat(action: Action, names: list[str]) -> str:
    """Return BVH text with every bone a child of the root with six channels: lossless."""
    lines = ["HIERARCHY", "ROOT agent", "{", "OFFSET 0 0 0", _ROOT_CHANNELS]
    for name in names:
        lines += [f"JOINT {name}", "{", "OFFSET 0 0 0", _ROOT_CHANNELS, *_END_SITE, "}"]
    poses = np.concatenate([action.world_from_agent[:, None], action.agent_from_bone], 1)
    channels = np.concatenate([poses[..., :3, 3], _turns(poses[..., :3, :3])], -1)
    return _text([*lines, "}"], action, channels.reshape(len(poses), -1))


def hierarchical(action: Action, tree: Tree, rest: Float[np.ndarray, "bone 4 4"], names: list[str]) -> str:
    """Return BVH text with a joint at each pivot; zero is rest. An end `<bone>_centre` is its centre."""
    lines = ["HIERARCHY"]
    root = tree.order[0]
    written: list[int] = []

    def put(bone: int, offset: np.ndarray) -> None:
        written.append(bone)
        kind, channels = ("ROOT", _ROOT_CHANNELS) if bone == root else ("JOINT", _ROTATION_CHANNELS)
        lines.extend([f"{kind} {names[bone]}", "{", _offset(offset), channels])
        for child in (other for other in tree.order if tree.parent[other] == bone):
            put(child, tree.pivot_agent[child] - tree.pivot_agent[bone])
        centre = _offset(rest[bone, :3, 3] - tree.pivot_agent[bone])
        lines.extend([f"JOINT {names[bone]}_centre", "{", centre, "CHANNELS 0", *_END_SITE, "}", "}"])

    put(root, np.zeros(3))
    motion = action.agent_from_bone @ rigid.inverse(rest)
    world = action.world_from_agent[:, None, :3, :3] @ motion[..., :3, :3]
    centre = action.world_from_agent[:, :3, :3] @ action.agent_from_bone[:, root, :3, 3, None]
    columns = [centre[..., 0] + action.world_from_agent[:, :3, 3]]
    for bone in written:
        parent = np.eye(3) if bone == root else np.swapaxes(world[:, tree.parent[bone]], 1, 2)
        columns.append(_turns(parent @ world[:, bone]))
    return _text(lines, action, np.concatenate(columns, 1))


def read_places(path: Path, names: list[str]) -> Float[np.ndarray, "frame joint 3"]:
    """Read a file by forward kinematics and return the positions of the named joints, metres."""
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
            case "CHANNELS":
                count = int(rest[0])
                values, column = rows[:, column : column + count], column + count
                place, turn = values[:, :3] if count == 6 else np.zeros((len(rows), 3)), np.eye(3)
                if count:
                    turn = Rotation.from_euler(_ORDER, values[:, -3:], degrees=True).as_matrix()
                stack[-1] = stack[-1] @ rigid.make(np.broadcast_to(turn, (len(rows), 3, 3)), place)
                places[name] = stack[-1][:, :3, 3]
            case "}":
                stack.pop()
    return np.stack([places[joint] for joint in names], 1)


def _turns(rotation: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3"]:
    angles = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_euler(_ORDER, degrees=True)
    return angles.reshape(*rotation.shape[:-2], 3)


def _offset(offset: Float[np.ndarray, "3"]) -> str:
    return "OFFSET " + " ".join(f"{value:.6f}" for value in offset)


def _text(lines: list[str], action: Action, channels: Float[np.ndarray, "frame channel"]) -> str:
    step_s = action.time_s[-1] / max(len(action.time_s) - 1, 1)
    rows = [" ".join(f"{value:.6f}" for value in row) for row in channels]
    return "\n".join([*lines, "MOTION", f"Frames: {len(rows)}", f"Frame Time: {step_s:.8f}", *rows, ""])
