"""A real kitchen: the template from one half of a walk, single frames of the other half localized in it."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from jaxtyping import Float

from pipeline.backends.descriptors import Describer
from pipeline.data.clips import Clip
from pipeline.localization import localizer as model
from pipeline.metrics.pose_errors import PoseErrors, constant_between, pose_errors
from stages.build_scene_template import template
from stages.build_scene_template.config import Config as TemplateConfig
from stages.evaluate import localizing
from stages.train_localizer import training
from stages.train_localizer.config import Config, SceneConfig
from tests.real.seven_scenes import Half, halves

FRAMES = range(25)
NEAR = (7.0, 0.15)
"""degrees and meters of the recall by which methods are compared"""


@dataclass(frozen=True)
class Kitchen:
    """The template of the first half, and the second half."""

    made: template.SceneTemplate
    walk: Half
    session: Half
    truth: Float[np.ndarray, "frame 4 4"]
    """cameras of the session in the world of the template"""


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory) -> Kitchen:
    walk, session = halves(tmp_path_factory.mktemp("kitchen"))
    cv2.setNumThreads(1)
    made, _ = template.build(
        walk.clip,
        np.zeros((len(walk.clip), 4, 4, 2), np.float16),
        TemplateConfig(),
        Path(tmp_path_factory.mktemp("workspace")),
    )
    world = constant_between(made.world_from_camera, walk.world_from_camera)
    return Kitchen(made, walk, session, world @ session.world_from_camera)


def _trained(
    made: template.SceneTemplate, walk: Clip, config: Config, rng: np.random.Generator
) -> model.Localizer:
    shown = training.scene_views(made.mesh, made.world_from_camera, made.floor_m, walk, config.scene, rng)
    return training.train(shown, config, Describer(), "cpu", rng)[0]


def _near(errors: PoseErrors) -> float:
    return float(((errors.degrees <= NEAR[0]) & (errors.meters <= NEAR[1])).mean())


@pytest.mark.slow
def test_template_is_metric_without_odometry(kitchen: Kitchen):
    truth = (
        constant_between(kitchen.made.world_from_camera, kitchen.walk.world_from_camera)
        @ kitchen.walk.world_from_camera
    )
    errors = pose_errors(kitchen.made.world_from_camera, truth)
    assert np.sqrt((errors.meters**2).mean()) <= 0.08
    assert len(kitchen.made.start.registered) == len(kitchen.walk.clip)


@pytest.mark.slow
def test_single_frames_are_localized_better_than_by_sift(kitchen: Kitchen):
    made, walk, clip = kitchen.made, kitchen.walk.clip, kitchen.session.clip
    localizer = _trained(made, walk, Config(scene=SceneConfig(held_out=40)), np.random.default_rng(0))
    hide = [np.zeros(clip.color_size, bool)] * len(clip)
    ours = pose_errors(localizing.placed_by_localizer(localizer, clip, FRAMES, hide)[0], kitchen.truth)
    points = localizing.sift_map(walk, made.world_from_camera, FRAMES)
    sift = pose_errors(localizing.placed_by_sift(points, clip, FRAMES), kitchen.truth)
    assert np.median(ours.degrees) <= 4.0
    assert np.median(ours.meters) <= 0.06
    assert _near(ours) > _near(sift)


@pytest.mark.slow
def test_confidence_separates_wrong_poses(kitchen: Kitchen):
    """A frame of noise has no confident pose."""
    made, rng = kitchen.made, np.random.default_rng(0)
    config = Config(scene=SceneConfig(views=60, held_out=40, frames=25))
    localizer = _trained(made, kitchen.walk.clip, config, rng)
    clip = kitchen.session.clip
    noise = rng.integers(0, 255, (*clip.color_size, 3)).astype(np.uint8)
    blurred = cv2.GaussianBlur(noise, (0, 0), 5)
    answers = localizer.localize(blurred, clip.depth(0), clip.depth_intrinsics[0], clip.intrinsics[0])
    right = localizer.localize(clip.color(0), clip.depth(0), clip.depth_intrinsics[0], clip.intrinsics[0])
    assert isinstance(right[0], model.PoseHypothesis)
    assert not answers or answers[0].probability < 0.5 * right[0].probability
