"""How physical motion is that was recorded and that the model makes: depth inside the scene, and feet that
slide.

Both are measured in the same test windows, at 30 fps, with contact vertices that were found in the training
sessions. The foot that moves least, of those near the scene, should stand; its speed is the slide.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from pipeline.behavior.trajectories import RATE_HZ, TEST, TRAIN, BehaviorData, Future
from pipeline.data import plots, ply
from pipeline.geometry import rigid
from pipeline.longterm.bodies import load_body
from pipeline.longterm.contacts import find_contact_vertices
from pipeline.longterm.plausibility import Plausibility, PlausibilityMeter
from pipeline.longterm.short_motions import BodyMotion, resample_motion, stretches
from pipeline.longterm.surroundings import MotionScene
from pipeline.metrics.metrics import Metrics
from pipeline.rivals.predictors import Predictor, Samples

WINDOWS = 16
"""Test windows in which motion is judged; each costs a second."""
KINDS = {"recorded": "recorded", "ats": "generated"}
STYLES = {"recorded": (plots.BLUE, "--"), "ats": (plots.ORANGE, "-")}
MEASURES = ("penetration_m", "foot_slide_m_s", "non_collision_share", "contact_share")
NAMES = (
    "behavior/physical_windows",
    *(f"behavior/{kind}/{measure}" for kind in KINDS for measure in MEASURES),
)
PICTURE = (
    "How physical motion is in the test windows, recorded (dashed) and generated: "
    "share of windows that are better than a value."
)


def physical_metrics(
    data: BehaviorData, ours: Predictor, reconstruction: Path, *, seed: int, windows: int = WINDOWS
) -> Metrics:
    """Judge some test windows, evenly spread: what was recorded, and one plan of ours in each."""
    metrics, test = Metrics(), data.indices(TEST)
    learned = _stretches(data)
    if len(test) == 0 or not learned:
        metrics.skip(NAMES, "no test window, or no session that shows the animal for two seconds")
        return metrics
    judge = _judge(data, learned, reconstruction)
    chosen = test[plots.sample(len(test), windows)]
    metrics.put("behavior/physical_windows", len(chosen))
    context, future = data.windows(chosen)
    made = ours.sample(context, 1, np.random.default_rng(seed))
    found = {"recorded": _judged(judge, _recorded(future)), "ats": _judged(judge, _sampled(made))}
    for kind, worth in found.items():
        _put(metrics, kind, worth)
    metrics.charts[PICTURE] = _drawn(found)
    return metrics


def _judge(data: BehaviorData, learned: Sequence[BodyMotion], reconstruction: Path) -> PlausibilityMeter:
    body = load_body(reconstruction)
    roots = np.concatenate(
        [track.world_from_agent[track.valid, :3, 3] for track in data.trajectories.values()]
    )
    scene = MotionScene.for_motion(ply.read_ply(reconstruction / "scene.ply"), roots).distance
    return PlausibilityMeter(body, find_contact_vertices(body, list(learned), [scene] * len(learned)), scene)


def _stretches(data: BehaviorData) -> list[BodyMotion]:
    sessions = {data.videos[video] for video in data.video[data.split == TRAIN]}
    return [stretch for session in sorted(sessions) for stretch in stretches(data.trajectories[session])]


def _recorded(future: Future) -> list[BodyMotion]:
    return [BodyMotion(*parts) for parts in zip(future.world_from_agent, future.agent_from_bone, strict=True)]


def _sampled(made: Samples) -> list[BodyMotion]:
    """Put the one sampled plan of each window together."""
    rotation, path, bones = made.rotation, made.path, made.agent_from_bone
    assert rotation is not None and path is not None and bones is not None, "whole plans are judged"
    return [
        BodyMotion(rigid.make(turn[0], way[0]), posed[0])
        for turn, way, posed in zip(rotation, path, bones, strict=True)
    ]


def _judged(judge: PlausibilityMeter, motions: Sequence[BodyMotion]) -> list[Plausibility]:
    found = []
    for motion in motions:
        even = resample_motion(np.arange(len(motion)) / RATE_HZ, motion)
        found.append(judge.plausibility(even, judge.stance(even)))
    return found


def _put(metrics: Metrics, kind: str, worth: Sequence[Plausibility]) -> None:
    slide = _slides(worth)
    metrics.put(f"behavior/{kind}/penetration_m", float(np.mean([each.penetration_m for each in worth])))
    metrics.put(
        f"behavior/{kind}/foot_slide_m_s",
        float(np.median(slide)) if len(slide) else np.nan,
        "no foot ever comes near the scene",
    )
    metrics.put(
        f"behavior/{kind}/non_collision_share", float(np.mean([each.non_collision for each in worth]))
    )
    metrics.put(f"behavior/{kind}/contact_share", float(np.mean([each.contact for each in worth])))


def _slides(worth: Sequence[Plausibility]) -> Float[np.ndarray, "window"]:
    """Return the slide of every window in which a foot comes near the scene."""
    slide = np.array([each.least_slide_m_s for each in worth])
    return slide[np.isfinite(slide)]


def _drawn(found: Mapping[str, Sequence[Plausibility]]) -> UInt8[np.ndarray, "height width 3"]:
    figure, grid = plots.panels(1, 2, width_in=9.2, height_in=3.2)
    panels = (
        (
            "mean depth of the body inside the scene (mm)",
            lambda worth: 1000 * np.array([each.penetration_m for each in worth]),
        ),
        ("speed of the foot that should stand (cm/s)", lambda worth: 100 * _slides(worth)),
    )
    for axes, (label, values_of) in zip(grid[0], panels, strict=True):
        for kind, worth in found.items():
            values, (color, dash) = np.sort(values_of(worth)).clip(0.1), STYLES[kind]
            share = np.arange(1, len(values) + 1) / max(len(values), 1)
            middle = f"{np.median(values):.1f}" if len(values) else "none"
            axes.step(values, share, dash, color=color, where="post", label=f"{KINDS[kind]}, median {middle}")
        axes.set(xscale="log", xlabel=label, ylabel="share of windows", ylim=(0, 1.02))
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False, fontsize=8)
    return plots.pixels(figure)
