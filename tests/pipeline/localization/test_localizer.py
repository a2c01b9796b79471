"""Localizers: calibrated confidence, answers for unseen views, and saving."""

import numpy as np
import pytest

from pipeline.backends.descriptors import Describer
from pipeline.geometry.meshes import RayCaster
from pipeline.localization import localizer as model
from pipeline.metrics.pose_errors import pose_errors
from stages.train_localizer import training
from stages.train_localizer.config import Config, SceneConfig
from tests.stages.textured_room import INTRINSICS, SIZE, MemoryClip, textured_room, walk


@pytest.fixture(scope="module")
def scene():
    mesh, truth = textured_room(), walk(20)
    clip = MemoryClip(RayCaster(mesh), truth, None)
    config = Config(scene=SceneConfig(views=50, held_out=16, frames=6, focal_px=90.0, pitch_deg=(-50.0, 0.0)))
    rng = np.random.default_rng(0)
    shown = training.scene_views(mesh, truth, 0.0, clip, config.scene, rng)
    return clip, *training.train(shown, config, Describer(), "cpu", rng)


@pytest.mark.slow
def test_bank_localizes_unseen_views(scene):
    clip, localizer, held = scene
    fresh = MemoryClip(clip.caster, walk(12, seed=5), None)
    answers = [localizer.localize(fresh.color(i), fresh.depth(i), INTRINSICS, INTRINSICS) for i in range(12)]
    found = np.stack([answer[0].map_from_camera for answer in answers])
    errors = pose_errors(found, fresh.truth)
    assert np.median(errors.degrees) < 1.5
    assert np.median(errors.meters) < 0.05
    assert held.good.mean() > 0.5
    assert answers[0][0].probability > 0.5


def test_masked_pictures_give_no_answer(scene):
    clip, localizer, _ = scene
    assert (
        localizer.localize(clip.color(0), clip.depth(0), INTRINSICS, INTRINSICS, np.zeros(SIZE, bool)) == []
    )


def test_localizer_survives_saving(scene, tmp_path):
    clip, localizer, _ = scene
    model.save(tmp_path, localizer, {"views": 1})
    again = model.load(tmp_path)
    query = (clip.color(3), clip.depth(3), INTRINSICS, INTRINSICS)
    first, second = localizer.localize(*query)[0], again.localize(*query)[0]
    assert (first.map_from_camera == second.map_from_camera).all()
    assert first.probability == second.probability


def test_calibration_is_a_monotonic_probability():
    rng = np.random.default_rng(0)
    score = rng.uniform(0, 1, 400)
    truth = 1 / (1 + np.exp(-(12 * score - 5)))
    fitted = model.calibrate(score, rng.random(400) < truth)
    assert np.abs(fitted.probability(score) - truth).mean() < 0.06
    assert (np.diff(fitted.probability(np.linspace(0, 1, 20))) > 0).all()


def test_separable_scores_stay_finite():
    fitted = model.calibrate(np.array([0.1, 0.2, 0.8, 0.9]), np.array([False, False, True, True]))
    assert np.isfinite([fitted.bias, fitted.slope]).all()
    assert fitted.probability(0.9) > 0.7 > 0.3 > fitted.probability(0.1)
