"""Keep the truth of a recording, for `evaluate` alone: cameras, animal, masks, noiseless depth, flow.

Everything refers to the upright picture.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from pipeline.data import npz
from pipeline.geometry import cameras
from stages.synthesize_capture.film import Frame, Stage, matrices, true_flow
from stages.synthesize_capture.script import Script

VISIBLE_SHARE = 0.001
"""Share of the picture that must show the animal for it to count as visible."""
FLOW_GAP_S = 0.1


@dataclass
class TruthWriter:
    """Collects one recording's truth frame by frame, then writes it."""

    script: Script
    keep_depth: bool
    number: int = 0
    """1: the companion is the agent."""
    masks: list[np.ndarray] = field(default_factory=list)
    others: list[np.ndarray] = field(default_factory=list)
    visitor_seen: list[float] = field(default_factory=list)
    visitor_top_m: list[float] = field(default_factory=list)
    depth: list[np.ndarray] = field(default_factory=list)
    vertices: list[np.ndarray] = field(default_factory=list)

    def add(self, frame: Frame, index: int) -> None:
        """Add one frame."""
        turns, motion = self.script.quarter_turns, self.script.motions[self.number]
        self.masks.append(cameras.turn_image(frame.masks[self.number], turns))
        if any(other is not None for other in self.script.motions[1:]):
            others = np.delete(frame.masks, self.number, axis=0)
            self.others.append(cameras.turn_image(np.any(others, axis=0), turns))
        self.visitor_seen.append(float(frame.masks[2].mean()))
        visitor = frame.vertices_world[2]
        self.visitor_top_m.append(np.nan if visitor is None else float(visitor[:, 1].max()))
        if self.keep_depth:
            self.depth.append(cameras.turn_image(frame.true_depth, turns).astype(np.float16))
        vertices_world = frame.vertices_world[self.number]
        if vertices_world is not None and motion is not None:
            self.vertices.append((vertices_world - motion.world_from_agent[index, :3, 3]).astype(np.float16))

    def visible(self) -> Bool[np.ndarray, "frame"]:
        """Return in which frames the animal is visible."""
        return np.array([mask.mean() > VISIBLE_SHARE for mask in self.masks])

    def write(self, folder: Path) -> None:
        """Write the recording's files into the truth folder."""
        script, path, motion = self.script, folder / self.script.name, self.script.motions[self.number]
        turns, size, depth_size = script.quarter_turns, script.phone.color_size, script.phone.depth_size
        stored = matrices(script.intrinsics)
        contents = {
            "timestamp_s": script.timestamp_s,
            "world_from_camera": cameras.turn_camera(script.world_from_camera, turns),
            "intrinsics": cameras.turn_intrinsics(stored, size, turns),
            "agent_visible": self.visible(),
            "moving": script.moving[self.number],
        }
        if motion is not None:
            contents["world_from_agent"] = motion.world_from_agent
            contents["agent_from_bone"] = motion.agent_from_bone.astype(np.float32)
            contents["agent_vertices_world"] = np.stack(self.vertices)
            _save_masks(path.with_suffix(".masks.npz"), self.masks)
        if self.others:
            _save_masks(path.with_suffix(".others.npz"), self.others)
        if script.motions[2] is not None:
            contents["world_from_visitor"] = script.motions[2].world_from_agent
            contents["visitor_seen"] = np.array(self.visitor_seen, np.float32)
            contents["visitor_top_m"] = np.array(self.visitor_top_m, np.float32)
        npz.save(path.with_suffix(".npz"), compress=False, **contents)
        if self.keep_depth:
            lens = cameras.scale_intrinsics(stored, size, depth_size)
            lens = cameras.turn_intrinsics(lens, depth_size, turns)
            depth = np.stack(self.depth)
            npz.save(path.with_suffix(".depth.npz"), compress=True, depth=depth, depth_intrinsics=lens)


def _save_masks(path: Path, masks: Sequence[np.ndarray]) -> None:
    shape = np.array((len(masks), *masks[0].shape), np.int64)
    npz.save(path, compress=True, packed=np.packbits(np.stack(masks), axis=-1), shape=shape)


def write_flow(stage: Stage, folder: Path, *, pairs: int) -> None:
    """Write the true flow of some pairs of frames about a tenth of a second apart."""
    times = stage.script.timestamp_s
    first = np.unique(
        np.linspace(0, np.searchsorted(times, times[-1] - FLOW_GAP_S) - 1, pairs).astype(np.int64)
    )
    second = [int(np.argmin(np.abs(times - times[index] - FLOW_GAP_S))) for index in first]
    flow = np.stack([true_flow(stage, int(a), b) for a, b in zip(first, second, strict=True)])
    npz.save(
        folder / f"{stage.script.name}.flow.npz",
        compress=True,
        frame_index=first,
        second_index=np.array(second, np.int64),
        flow=flow.astype(np.float16),
    )
