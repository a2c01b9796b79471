"""The truth of one recording, at the frames that were extracted from it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.data import npz

AGENT_FIELDS = ("world_from_camera", "intrinsics", "agent_visible", "moving", "world_from_agent")
FILED_AS = {name: name for name in (*AGENT_FIELDS, "world_from_visitor", "visitor_seen", "visitor_top_m")} | {
    "vertices": "agent_vertices_world"
}
"""Names in the file of the fields below; those of agent and visitor only where there is one."""


@dataclass(frozen=True)
class RecordingTruth:
    """Everything known of a recording, in the truth's own frames; without an agent its poses are NaN, its
    vertices none and its masks empty.
    """

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    intrinsics: Float[np.ndarray, "frame 3 3"]
    agent_visible: Bool[np.ndarray, "frame"]
    moving: Bool[np.ndarray, "frame"]
    world_from_agent: Float[np.ndarray, "frame 4 4"]
    vertices: Float[np.ndarray, "frame vertex 3"]
    """world positions less the agent's"""
    masks: Bool[np.ndarray, "frame height width"]
    others: Bool[np.ndarray, "frame height width"] | None = None
    """masks of the home's other animals and of visitors; None where there are none"""
    world_from_visitor: Float[np.ndarray, "frame 4 4"] | None = None
    """pose of another person's body; None where there is none"""
    visitor_seen: Float[np.ndarray, "frame"] | None = None
    """share of the picture that shows the visitor"""
    visitor_top_m: Float[np.ndarray, "frame"] | None = None
    """height of the visitor's highest point above the floor"""

    @classmethod
    def open(cls, folder: Path, name: str, source_index: Int[np.ndarray, "frame"]) -> "RecordingTruth":
        """Read ``<name>.npz``, ``<name>.masks.npz`` and ``<name>.others.npz`` for the extracted frames."""
        table = npz.load(folder / f"{name}.npz")
        frames = len(source_index)
        no_agent = {"world_from_agent": np.full((frames, 4, 4), np.nan), "vertices": np.zeros((frames, 0, 3))}
        masks = np.zeros((frames, 0, 0), bool)
        if "world_from_agent" in table:
            masks = _masks(folder / f"{name}.masks.npz")[source_index]
        parts = {field: table[key][source_index] for field, key in FILED_AS.items() if key in table}
        others = folder / f"{name}.others.npz"
        return cls(
            **no_agent | parts, masks=masks, others=_masks(others)[source_index] if others.exists() else None
        )

    def vertices_world(self, frame: int) -> Float[np.ndarray, "vertex 3"]:
        """Return the true surface's vertices of one frame, meters, in the truth's world."""
        return self.vertices[frame].astype(np.float64) + self.world_from_agent[frame, :3, 3]


def read_depth(
    folder: Path, name: str, source_index: Int[np.ndarray, "frame"]
) -> tuple[Float[np.ndarray, "frame height width"], Float[np.ndarray, "frame 3 3"]]:
    """Read noiseless depth (meters) and its intrinsics for the extracted frames: ``<name>.depth.npz``."""
    table = npz.load(folder / f"{name}.depth.npz")
    intrinsics = table["depth_intrinsics"]
    if intrinsics.ndim == 2:
        intrinsics = np.broadcast_to(intrinsics, (len(table["depth"]), 3, 3))
    return table["depth"][source_index].astype(np.float32), intrinsics[source_index]


@dataclass(frozen=True)
class TrueFlow:
    """True flow of neighboring extracted frames, at the stored grid."""

    first: Int[np.ndarray, "pair"]
    """extracted frame; the flow leads to the next one"""
    flow: Float[np.ndarray, "pair height width 2"]
    """color pixels, NaN where the point is not seen in both"""


def read_flow(folder: Path, name: str, source_index: Int[np.ndarray, "frame"]) -> TrueFlow | None:
    """Read ``<name>.flow.npz`` and keep the pairs that extraction made neighbors; None without a file."""
    path = folder / f"{name}.flow.npz"
    if not path.exists():
        return None
    table = npz.load(path)
    position = {int(source): frame for frame, source in enumerate(source_index)}
    sources = zip(table["frame_index"].tolist(), table["second_index"].tolist(), strict=True)
    pairs = [
        (position.get(first, -1), position.get(second, -9), row)
        for row, (first, second) in enumerate(sources)
    ]
    neighbors = [(first, row) for first, second, row in pairs if first >= 0 and second == first + 1]
    first, row = np.array(neighbors, int).reshape(-1, 2).T
    return TrueFlow(first, table["flow"][row].astype(np.float32))


def _masks(path: Path) -> Bool[np.ndarray, "frame height width"]:
    table = npz.load(path)
    return np.unpackbits(table["packed"], axis=-1)[..., : table["shape"][2]].astype(bool)
