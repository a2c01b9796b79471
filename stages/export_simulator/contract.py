"""Assemble `simulator.json`, the contract between the simulator and its players."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.behavior.config import MAX_GUIDANCE, PlanSamplingConfig, ReplanningConfig
from pipeline.geometry import rigid
from stages.export_simulator.actions import SessionClip
from stages.export_simulator.export import SimulatorParts
from stages.export_simulator.reading import BehaviorAssets

VERSION = 3
"""Version of the contract's keys; players refuse others."""
GOAL_CHOICES = (1, 4, 16)
"""Numbers of goals sampled at once that a visitor can choose from."""
GOALS = 4
"""Default number of goals: enough to show their spread."""
FINE_STEPS = 50
"""Denoising steps of the finer setting, as in the paper."""
_WALKING_M_S = 0.15
"""Root speed above which the animal walks; below it shifts its weight."""
_DEFAULT_PACE_M_S = 0.4
"""Pace of an animal without recorded walking."""
MIN_SUPPORTED = 0.9
"""Share of recorded frames above something solid or filled floor below which the page and the report warn."""
_UNSUPPORTED = "Little of this floor was recorded: the animal may float or sink."


def contract(
    parts: SimulatorParts, behavior: BehaviorAssets, name: str, labels: Mapping[str, str], remark: str | None
) -> dict[str, Any]:
    """Assemble the table of one animal, which passes the sampler's own contract on unchanged.

    ``labels`` of recordings go by their id; ``remark`` is what a visitor should know of the home.
    """
    motions, setting, skin = parts.motions, parts.setting, parts.skin
    carried = behavior.supported is not None and behavior.supported >= MIN_SUPPORTED
    warning = " ".join(filter(None, (remark, None if carried else _UNSUPPORTED)))
    observers = np.concatenate([motion.world_from_camera[:, :3, 3] for motion in motions])
    heights = np.concatenate([motion.world_from_agent[:, 1, 3] for motion in motions])
    starts = np.cumsum([0] + [len(motion.timestamp_s) for motion in motions])
    return {
        "version": VERSION,
        "name": name,
        "units": {"length": "m", "time": "s", "angle": "rad"},
        "up": "+y",
        "quaternion": "wxyz",
        "rows": "a row is a rigid motion: place x y z, quaternion w x y z; "
        "a clip's frame is world_from_agent, agent_from_bone of each bone, world_from_camera",
        "scene": {
            "floor_m": round(setting.floor_m, 4),
            "bounds_m": np.round(setting.bounds_m, 4).tolist(),
            "warning": warning or None,
        },
        "observer": {
            "eye_height_m": round(float(np.median(observers[:, 1]) - setting.floor_m), 4),
            "start_m": np.round(np.median(observers[:, [0, 2]], axis=0), 4).tolist(),
        },
        "agent": {
            "bones": list(skin.bone_names),
            "rest": np.round(rigid_rows(skin.agent_from_bone_rest), 6).tolist(),
            **gait(motions),
            "root_height_m": [round(float(height), 4) for height in np.percentile(heights, [0.5, 99.5])],
            "skinning_residual_mm": loss_mm(parts.residual_m),
        },
        "clips": [
            {
                "name": motion.name,
                "label": labels.get(motion.name, motion.name),
                "start": int(start),
                "count": len(motion.timestamp_s),
            }
            for motion, start in zip(motions, starts[:-1], strict=True)
        ],
        "volume": behavior.volume,
        "controls": controls(behavior.contract["sampling"]),
        "replanning": vars(ReplanningConfig()),
        "behavior": behavior.contract,
    }


def controls(sampling: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return what a visitor sets, its range and default; `interactivity` is the scale of guidance."""
    steps = int(sampling["sequence_steps"])
    return {
        "interactivity": {
            "least": 0.0,
            "most": MAX_GUIDANCE,
            "default": float(sampling["guidance"]),
            "companions": PlanSamplingConfig.companions_guidance,
        },
        "samples": {"choices": list(GOAL_CHOICES), "default": GOALS},
        "steps": {"choices": sorted({steps, FINE_STEPS}), "default": steps},
    }


def loss_mm(residual_m: Float[np.ndarray, "frame vertex"]) -> dict[str, float]:
    """Sum up distances, in millimeters."""
    residual_mm = residual_m * 1000
    values = {"mean": residual_mm.mean(), "p99": np.percentile(residual_mm, 99), "max": residual_mm.max()}
    return {name: round(float(value), 3) for name, value in values.items()}


def rigid_rows(a_from_b: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 7"]:
    """Turn rigid motions into rows of place and quaternion wxyz."""
    turns = rigid.quaternion_from_rotation(a_from_b[..., :3, :3])
    return np.concatenate([a_from_b[..., :3, 3], turns], axis=-1)


def gait(motions: list[SessionClip]) -> dict[str, float]:
    """Return median speed and root height while walking."""
    places = [motion.world_from_agent[:, :3, 3] for motion in motions]
    steps = zip(places, motions, strict=True)
    velocity = [np.gradient(place[:, [0, 2]], motion.timestamp_s, axis=0) for place, motion in steps]
    speed, height = np.linalg.norm(np.concatenate(velocity), axis=1), np.concatenate(places)[:, 1]
    walking = speed > _WALKING_M_S
    height = height[walking] if walking.any() else height
    return {
        "pace_m_s": round(float(np.median(speed[walking])), 4) if walking.any() else _DEFAULT_PACE_M_S,
        "standing_m": round(float(np.median(height)), 4),
    }
