"""Compare the kinds of localizers in one run: error versus training time, on clean and degraded queries.

    python -m benchmarks.localizers cat

All kinds are trained on the same rendered views of the scene template and localize the same new renders (clean, low
contrast, blurred, dark) and frames of the sessions, against their registered poses. Times are CPU seconds of one
process; rendering and describing views is reported separately, since every kind needs it. Needs a finished
registration.
"""

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import torch
from jaxtyping import UInt8

from benchmarks import command_lines
from benchmarks.command_lines import recordings
from pipeline.backends.descriptors import Describer
from pipeline.data import npz, ply
from pipeline.data.clips import Clip, Masks
from pipeline.data.templates import SceneCameras
from pipeline.localization import localizer as model
from pipeline.metrics.pose_errors import pose_errors
from stages.train_localizer import described_views, training
from stages.train_localizer.config import Config, NetworkConfig, SceneConfig
from stages.train_localizer.views import RenderedView

RECALL_LIMITS = (5.0, 0.2)
"""degrees and meters within which a pose counts as correct"""


@dataclass(frozen=True)
class Setting:
    """One trained localizer."""

    kind: model.Kind
    views: int
    steps: int = 0


SETTINGS = (
    *(Setting("bank", views) for views in (100, 250, 500)),
    *(Setting("regression", 500, steps) for steps in (250, 1000, 2500)),
)


def degraded(
    picture: UInt8[np.ndarray, "height width 3"], degradation: str
) -> UInt8[np.ndarray, "height width 3"]:
    """Return a picture degraded by bad light or motion blur."""
    match degradation:
        case "clean":
            return picture
        case "low contrast":
            return np.round(0.25 * picture + 0.75 * picture.mean()).astype(np.uint8)
        case "blurred":
            return cv2.GaussianBlur(picture, (0, 0), 2.5)
        case "dark":
            noise = np.random.default_rng(int(picture[0, 0, 0])).normal(0, 3, picture.shape)
            return np.clip(np.round(0.12 * picture + noise), 0, 255).astype(np.uint8)
    raise ValueError(degradation)


QUERIES = ("clean", "low contrast", "blurred", "dark")


def errors_of_renders(
    localizer: model.Localizer, queries: list[RenderedView], degradation: str
) -> tuple[float, float, float]:
    """Return the median rotation (degrees) and translation (meters) error and the recall; no answer counts as wrong."""
    degraded_queries = iter([replace(query, color=degraded(query.color, degradation)) for query in queries])
    evaluated = described_views.evaluate(localizer, lambda: next(degraded_queries), len(queries))
    return _summary(evaluated.rotation_deg, evaluated.translation_m)


def errors_of_sessions(
    localizer: model.Localizer, build: Path, per_session: int
) -> tuple[float, float, float]:
    """Return the same over frames of the sessions, against their registered poses."""
    found, truth = [], []
    for path in sorted(build.glob("registration/*/poses.npz")):
        clip = Clip.open(build / "frames" / path.parent.name)
        masks = Masks.open(build / "masks" / path.parent.name)
        poses = npz.load(path, ("world_from_camera",))["world_from_camera"]
        for frame in np.linspace(0, len(clip) - 1, per_session).astype(int):
            camera = (clip.depth_intrinsics[frame], clip.intrinsics[frame])
            answers = localizer.localize(clip.color(frame), clip.depth(frame), *camera, masks[frame] == 0)
            found.append(answers[0].map_from_camera if answers else np.full((4, 4), np.nan))
            truth.append(poses[frame])
    errors = pose_errors(np.array(found), np.array(truth))
    return _summary(errors.degrees, errors.meters)


def _summary(rotation, translation):
    rotation = np.nan_to_num(rotation, nan=180.0, posinf=180.0)
    translation = np.nan_to_num(translation, nan=10.0, posinf=10.0)
    return (
        float(np.median(rotation)),
        float(np.median(translation)),
        float(((rotation <= RECALL_LIMITS[0]) & (translation <= RECALL_LIMITS[1])).mean()),
    )


def rows(build: Path, queries: int, per_session: int, settings: tuple[Setting, ...]) -> Iterator[str]:
    """Train and localize; yield the lines of a Markdown table as they are measured."""
    template = build / "scene_template"
    clip = Clip.open(build / "frames" / recordings(build, "walkthrough")[0])
    walk = SceneCameras.open(template).world_from_registered
    floor_m = json.loads((template / "world.json").read_text())["floor"]
    scene = SceneConfig(views=max(setting.views for setting in settings), held_out=40)
    scene_views, seconds = timed(
        lambda: training.scene_views(
            ply.read_ply(template / "mesh.ply"), walk, floor_m, clip, scene, np.random.default_rng(0)
        )
    )
    per_view = seconds / scene.views
    rng = np.random.default_rng(2)
    rendered_queries = [scene_views.draw_query(rng) for _ in range(queries)]
    yield f"{1000 * per_view:.0f} ms to render a view; {queries} new renders, {per_session} frames of each session; deg / m / recall"
    yield f"| kind | views | steps | training s | s / query | {' | '.join(QUERIES)} | sessions |"
    yield "|---" * (6 + len(QUERIES)) + "|"
    for setting in settings:
        training_views = replace(
            scene_views, pictures=scene_views.pictures[: setting.views] + scene_views.pictures[scene.views :]
        )
        rng = np.random.default_rng(1)
        config = Config(kind=setting.kind, network=NetworkConfig(steps=setting.steps))
        (localizer, _), training_s = timed(
            lambda c=config, p=training_views, r=rng: training.train(p, c, Describer(), "cpu", r)
        )
        render_errors, query_s = timed(
            lambda m=localizer: [
                errors_of_renders(m, rendered_queries, degradation) for degradation in QUERIES
            ]
        )
        cells = [*render_errors, errors_of_sessions(localizer, build, per_session)]
        per_query = query_s / len(QUERIES) / queries
        error_cells = " | ".join(f"{deg:.2f} / {meters:.3f} / {recall:.2f}" for deg, meters, recall in cells)
        yield f"| {setting.kind} | {setting.views} | {setting.steps or ''} | {training_s:.0f} | {per_query:.3f} | {error_cells} |"


def timed(work: Callable):
    """Return the result of a call and its CPU seconds."""
    start = time.process_time()
    return work(), time.process_time() - start


def main() -> None:
    """Print the table of one agent's build."""
    parser = command_lines.for_agent(__doc__)
    parser.add_argument("--queries", type=int, default=60, help="number of localized renders")
    parser.add_argument("--frames", type=int, default=12, help="localized frames per session")
    parser.add_argument(
        "--max-steps", type=int, default=2500, help="skip networks that are trained for longer"
    )
    parser.add_argument(
        "--kinds",
        nargs="+",
        default=list(get_args(model.Kind)),
        choices=get_args(model.Kind),
        help="kinds to compare",
    )
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    settings = tuple(
        setting
        for setting in SETTINGS
        if setting.steps <= arguments.max_steps and setting.kind in arguments.kinds
    )
    for line in rows(command_lines.build_of(arguments), arguments.queries, arguments.frames, settings):
        print(line, flush=True)


if __name__ == "__main__":
    main()
