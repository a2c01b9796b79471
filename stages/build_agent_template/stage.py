"""The stage: the turnaround -> canonical surface, bones, features and cameras."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.core.progress import log
from pipeline.data import ply, qa
from pipeline.data.clips import Clip, Masks
from pipeline.data.features import open_features
from pipeline.data.templates import AgentCameras, SkinTable, write_vertex_features
from stages.build_agent_template import pictures
from stages.build_agent_template.config import Config
from stages.build_agent_template.template import build


@dataclass(frozen=True)
class Inputs:
    """What the stage reads: folders of the turnaround by id."""

    frames: Mapping[str, Path]
    masks: Mapping[str, Path]
    features: Mapping[str, Path]


def run(inputs: Inputs, config: Config, out: Path) -> None:
    """Build the template from the turnaround into `out`; of several, the first in id order is used."""
    video = min(inputs.frames)
    if len(inputs.frames) > 1:
        log(f"several turnarounds: {video} is used")
    clip, masks = Clip.open(inputs.frames[video]), Masks.open(inputs.masks[video])
    features = open_features(inputs.features[video])
    template = build(clip, masks, features, config, np.random.default_rng(config.seed))
    log(f"surface: {len(template.mesh.vertices)} vertices from {template.coverage_deg:.0f} deg around")
    log(f"depth pictures agree within {1000 * template.residual_m:.0f} mm")
    ply.write_ply(out / "agent.ply", template.mesh)
    bones = template.bones
    SkinTable(template.weights, bones.agent_from_bone_rest, bones.bone_scale_m).write(out)
    write_vertex_features(out, template.features)
    poses = template.agent_from_camera
    AgentCameras(clip.timestamp_s, poses, clip.intrinsics, np.isfinite(poses[:, 0, 0])).write(out)
    checks, shown = pictures.report(template)
    qa.write(
        out,
        good="a whole animal, closed, with thin legs and tail, and one hue per limb",
        bad="a body with a hull of floor, doubled limbs, or one hue over several limbs",
        checks=checks,
        pictures=shown,
    )
