"""How physical motion is that was recorded and that the model makes: depth inside the scene, and feet that slide.

Both are measured in the same test windows, at 30 fps, with contact vertices that were found in the training sessions.
The foot that moves least, of those near the scene, should stand; its speed is the slide.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from pipeline import figures as drawing
from pipeline.files import meshes
from pipeline.models.bodies import load_body
from pipeline.models.contacts import find_contacts
from pipeline.models.plausibility import Judge, Plausibility
from pipeline.models.predictors import Predictor
from pipeline.models.short_motions import Moving, resampled, stretches
from pipeline.models.surroundings import Surroundings
from pipeline.models.trajectories import RATE_HZ, TEST, TRAIN, BehaviorData, Future
from pipeline.space import rigid
from stages.evaluate.figures import Figures

KINDS = {"recorded": "recorded", "ats": "generated"}
STYLES = {"recorded": ("#2f6f9f", "--"), "ats": ("#c8722b", "-")}
MEASURES = ("penetration_m", "foot_slide_m_s", "non_collision_share", "contact_share")
NAMES = ("behavior/physical_windows", *(f"behavior/{kind}/{measure}" for kind in KINDS for measure in MEASURES))
PICTURE = "How physical motion is in the test windows, recorded (dashed) and generated: share of windows that are better than a value."


def physical_figures(data: BehaviorData, ours: Predictor, reconstruction: Path, *, windows: int, seed: int) -> Figures:
    """Judge some test windows, evenly spread: what was recorded, and one plan of ours in each."""
    figures, test = Figures(), data.indices(TEST)
    learned = _stretches(data)
    if len(test) == 0 or not learned:
        figures.skip(NAMES, "no test window, or no session that shows the animal for two seconds")
        return figures
    judge = _judge(data, learned, reconstruction)
    chosen = test[np.unique(np.linspace(0, len(test) - 1, windows).astype(int))]
    figures.put("behavior/physical_windows", len(chosen))
    context, future = data.windows(chosen)
    made = ours.sample(context, 1, np.random.default_rng(seed))
    found = {
        "recorded": _judged(judge, _recorded(future)),
        "ats": _judged(judge, [_moving(*parts) for parts in zip(made.rotation, made.path, made.agent_from_bone, strict=True)]),
    }
    for kind, worth in found.items():
        _put(figures, kind, worth)
    figures.charts[PICTURE] = _drawn(found)
    return figures


def _judge(data: BehaviorData, learned: Sequence[Moving], reconstruction: Path) -> Judge:
    body = load_body(reconstruction)
    roots = np.concatenate([track.world_from_agent[track.valid, :3, 3] for track in data.trajectories.values()])
    scene = Surroundings.for_motion(meshes.read_ply(reconstruction / "scene.ply"), roots).distance
    return Judge(body, find_contacts(body, list(learned), [scene] * len(learned)), scene)


def _stretches(data: BehaviorData) -> list[Moving]:
    sessions = {data.videos[video] for video in data.video[data.split == TRAIN]}
    return [stretch for session in sorted(sessions) for stretch in stretches(data.trajectories[session])]


def _recorded(future: Future) -> list[Moving]:
    return [Moving(*parts) for parts in zip(future.world_from_agent, future.agent_from_bone, strict=True)]


def _moving(rotation: np.ndarray, path: np.ndarray, bones: np.ndarray) -> Moving:
    """Put the one sampled plan of a window together."""
    return Moving(rigid.make(rotation[0], path[0]), bones[0])


def _judged(judge: Judge, motions: Sequence[Moving]) -> list[Plausibility]:
    found = []
    for motion in motions:
        even = resampled(np.arange(len(motion)) / RATE_HZ, motion)
        found.append(judge.plausibility(even, judge.stance(even)))
    return found


def _put(figures: Figures, kind: str, worth: Sequence[Plausibility]) -> None:
    slide = _slides(worth)
    figures.put(f"behavior/{kind}/penetration_m", float(np.mean([each.penetration_m for each in worth])))
    figures.put(f"behavior/{kind}/foot_slide_m_s", float(np.median(slide)) if len(slide) else np.nan, "no foot ever comes near the scene")
    figures.put(f"behavior/{kind}/non_collision_share", float(np.mean([each.non_collision for each in worth])))
    figures.put(f"behavior/{kind}/contact_share", float(np.mean([each.contact for each in worth])))


def _slides(worth: Sequence[Plausibility]) -> Float[np.ndarray, "window"]:
    """Return the slide of every window in which a foot comes near the scene."""
    slide = np.array([each.least_slide_m_s for each in worth])
    return slide[np.isfinite(slide)]


def _drawn(found: Mapping[str, Sequence[Plausibility]]) -> UInt8[np.ndarray, "height width 3"]:
    figure = Figure(figsize=(9.2, 3.2), dpi=90, layout="constrained")
    panels = (
        ("mean depth of the body inside the scene (mm)", lambda worth: 1000 * np.array([each.penetration_m for each in worth])),
        ("speed of the foot that should stand (cm/s)", lambda worth: 100 * _slides(worth)),
    )
    for axes, (label, values_of) in zip(figure.subplots(1, 2), panels, strict=True):
        for kind, worth in found.items():
            values, (color, dash) = np.sort(values_of(worth)).clip(0.1), STYLES[kind]
            share, told = np.arange(1, len(values) + 1) / max(len(values), 1), f"{np.median(values):.1f}" if len(values) else "none"
            axes.step(values, share, dash, color=color, where="post", label=f"{KINDS[kind]}, median {told}")
        axes.set(xscale="log", xlabel=label, ylabel="share of windows", ylim=(0, 1.02))
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False, fontsize=8)
    return drawing.pixels(figure)
