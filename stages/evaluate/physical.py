"""How physical motion is that was recorded and that the model makes: depth inside the scene, and feet that
slide.

Both are measured in the same test windows, at 30 fps, with contact vertices that were found in the training
sessions. The foot that moves least, of those near the scene, should stand; its speed is the slide. Where the
recorded animal has a foot near the scene and the planned one never does, the slide is infinite.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.baselines.predictors import Predictor
from pipeline.behavior.trajectories import RATE_HZ, TEST, BehaviorData
from pipeline.geometry import rigid, subsampling
from pipeline.longterm.bodies import load_body
from pipeline.longterm.contacts import find_contact_vertices
from pipeline.longterm.plausibility import PlausibilityMeter
from pipeline.longterm.short_motions import BodyMotion, resample_motion, stretches
from pipeline.longterm.surroundings import MotionScene
from pipeline.metrics.metrics import Metrics, median

WINDOWS = 48
"""Test windows that are scored; of 16, foot skate varies by a quarter from one draw to the next."""
MEANS = {"penetration_m": "penetration_m", "non_collision_share": "non_collision", "contact_share": "contact"}
"""Metrics that are averaged over windows, with the attribute of `Plausibility` of each."""
NAMES = (
    "behavior/physical_windows",
    *(f"behavior/{kind}/{measure}" for kind in ("recorded", "ats") for measure in (*MEANS, "foot_slide_m_s")),
)


def physical_metrics(data: BehaviorData, ours: Predictor, reconstruction: Path, *, seed: int) -> Metrics:
    """Score recorded motion and one plan of ours on some evenly spread test windows."""
    metrics, test = Metrics(), data.indices(TEST)
    learned = [part for trajectory in data.training.values() for part in stretches(trajectory)]
    if len(test) == 0 or not learned:
        metrics.skip(NAMES, "no test window, or no session that shows the animal for two seconds")
        return metrics
    body = load_body(reconstruction)
    scene = MotionScene.reconstructed(reconstruction, data.trajectories.values()).distance
    contacts = find_contact_vertices(body, learned, [scene] * len(learned))
    meter = PlausibilityMeter(body, contacts, scene)
    chosen = test[subsampling.evenly(len(test), WINDOWS)]
    metrics.put("behavior/physical_windows", len(chosen))
    context, future = data.windows(chosen)
    made = ours.sample(context, 1, np.random.default_rng(seed))
    rotation, path, bones = made.rotation, made.path, made.agent_from_bone
    assert rotation is not None and path is not None and bones is not None, "whole plans are judged"
    planned = rigid.make(rotation[:, 0], path[:, 0]), bones[:, 0]
    slide = {}
    for kind, pair in (("recorded", (future.world_from_agent, future.agent_from_bone)), ("ats", planned)):
        motions = [BodyMotion(*motion) for motion in zip(*pair, strict=True)]
        slide[kind] = _put(metrics, kind, meter, motions)
    stands = np.isfinite(slide["recorded"])
    for kind, why in (("recorded", "no foot comes near the scene"), ("ats", "most plans have none near it")):
        counted = np.nan_to_num(slide[kind][stands], nan=np.inf)
        metrics.put(f"behavior/{kind}/foot_slide_m_s", median(counted), why)
    return metrics


def _put(
    metrics: Metrics, kind: str, meter: PlausibilityMeter, motions: Sequence[BodyMotion]
) -> Float[np.ndarray, "window"]:
    """Put means over windows, and return the slide in each; NaN where no foot comes near the scene."""
    resampled = [resample_motion(np.arange(len(motion)) / RATE_HZ, motion) for motion in motions]
    found = [meter.plausibility(motion, meter.stance(motion)) for motion in resampled]
    for measure, name in MEANS.items():
        metrics.put(f"behavior/{kind}/{measure}", float(np.mean([getattr(each, name) for each in found])))
    return np.array([each.min_slide_m_s for each in found])
