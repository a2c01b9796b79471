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
from stages.synthesize_capture.gait import AnimalMotion
from stages.synthesize_capture.script import Script

VISIBLE_SHARE = 0.001
"""Share of the picture that must show the animal for it to count as visible."""
FLOW_GAP_S = 0.1


@dataclass
class TruthWriter:
    """Collects one recording's truth frame by frame, then writes it."""

    script: Script
    keep_depth: bool
    of_companion: bool = False
    """Whether the second animal is the agent, and the first one the other."""
    masks: list[np.ndarray] = field(default_factory=list)
    others: list[np.ndarray] = field(default_factory=list)
    depth: list[np.ndarray] = field(default_factory=list)
    vertices: list[np.ndarray] = field(default_factory=list)

    def add(self, frame: Frame, index: int) -> None:
        """Take over one frame."""
        turns = self.script.quarter_turns
        own, other = frame.mask, frame.companion_mask
        vertices_world = frame.vertices_world
        if self.of_companion:
            own, other, vertices_world = other, own, frame.companion_vertices_world
        self.masks.append(cameras.turn_image(own, turns))
        if self.script.companion_motion is not None:
            self.others.append(cameras.turn_image(other, turns))
        if self.keep_depth:
            self.depth.append(cameras.turn_image(frame.true_depth, turns).astype(np.float16))
        if vertices_world is not None and self.motion is not None:
            root = self.motion.world_from_agent[index, :3, 3]
            self.vertices.append((vertices_world - root).astype(np.float16))

    @property
    def motion(self) -> AnimalMotion | None:
        """Return the motion of the agent; None where it is not there."""
        return self.script.companion_motion if self.of_companion else self.script.motion

    def visible(self) -> Bool[np.ndarray, "frame"]:
        """Return in which frames the animal can be seen."""
        return np.array([mask.mean() > VISIBLE_SHARE for mask in self.masks])

    def write(self, folder: Path) -> None:
        """Write the recording's files into the truth folder."""
        script, name = self.script, self.script.name
        contents = {
            "timestamp_s": script.timestamp_s,
            "world_from_camera": cameras.turn_camera(script.world_from_camera, script.quarter_turns),
            "intrinsics": cameras.turn_intrinsics(
                matrices(script.intrinsics), script.color_size, script.quarter_turns
            ),
            "agent_visible": self.visible(),
            "moving": script.moving,
        }
        if self.of_companion:
            still = np.zeros(len(script.timestamp_s), bool)
            contents["moving"] = still if script.companion_moving is None else script.companion_moving
        if self.motion is not None:
            contents["world_from_agent"] = self.motion.world_from_agent
            contents["agent_from_bone"] = self.motion.agent_from_bone.astype(np.float32)
            contents["agent_vertices_world"] = np.stack(self.vertices)
            _save_masks(folder / f"{name}.masks.npz", self.masks)
        if self.others:
            _save_masks(folder / f"{name}.others.npz", self.others)
        npz.save(folder / f"{name}.npz", compress=False, **contents)
        if self.keep_depth:
            stored = cameras.scale_intrinsics(
                matrices(script.intrinsics), script.color_size, script.depth_size
            )
            depth_intrinsics = cameras.turn_intrinsics(stored, script.depth_size, script.quarter_turns)
            npz.save(
                folder / f"{name}.depth.npz",
                compress=True,
                depth=np.stack(self.depth),
                depth_intrinsics=depth_intrinsics,
            )


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
