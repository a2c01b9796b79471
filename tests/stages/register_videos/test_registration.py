"""Registration of a recording in a textured room: accuracy, confidence, and rejection of other rooms."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.backends.descriptors import Describer
from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh, RayCaster
from pipeline.mapping import depth_scans
from pipeline.metrics.pose_errors import pose_errors
from stages.register_videos import alignment, flow_alignment, pictures, registration
from stages.register_videos import votes as voting
from stages.register_videos.confidence import appearance_probability, camera_confidence, score_appearance
from stages.register_videos.config import AlignmentConfig, ConfidenceConfig, VoteConfig
from stages.register_videos.config import Config as RegistrationConfig
from stages.train_localizer import training
from stages.train_localizer.config import Config, SceneConfig
from tests.stages.textured_room import MemoryClip, NoAgent, drifting, textured_room, walk


@pytest.fixture(scope="module")
def maps() -> registration.Maps:
    mesh, path = textured_room(), walk(20)
    clip = MemoryClip(RayCaster(mesh), path, None)
    config = Config(scene=SceneConfig(views=45, held_out=14, frames=8, focal_px=90.0, pitch_deg=(-50.0, 0.0)))
    rng = np.random.default_rng(0)
    shown = training.scene_views(mesh, path, 0.0, clip, config.scene, rng)
    scene, _ = training.train(shown, config, Describer(), "cpu", rng)
    agent = Mesh(
        np.eye(3, dtype=np.float32) * 0.1, np.array([[0, 1, 2]], np.int32), np.full((3, 3), 90, np.uint8)
    )
    return registration.Maps(mesh, 0.0, agent, scene, scene)


@pytest.mark.slow
@pytest.mark.parametrize("with_odometry", [True, False])
def test_recording_is_registered(maps, with_odometry):
    truth = walk(40, seed=7)
    clip = MemoryClip(
        RayCaster(maps.scene), truth, drifting(truth, 2, deg=0.03, m=0.001) if with_odometry else None
    )
    config = RegistrationConfig(alignment=AlignmentConfig(stride_px=9, flow_every_frames=8))
    found = registration.register(clip, NoAgent(40), maps, config, np.random.default_rng(0))
    errors = pose_errors(found.aligned.world_from_camera, truth)
    assert np.median(errors.degrees) < (0.3 if with_odometry else 1.0), "degrees"
    assert np.median(errors.meters) < (0.015 if with_odometry else 0.04), "meters"
    assert found.confidence.mean() > 0.8, "all frames are right"
    assert not found.roots.visible.any()
    assert np.isnan(found.roots.world_from_agent).all()


@pytest.mark.slow
def test_registration_is_robust_to_a_tracking_jump(maps):
    truth = walk(40, seed=7)
    odometry = drifting(truth, 2, deg=0.03, m=0.001)
    odometry[20:, :3, 3] += np.array([0.5, 0.0, 0.35])
    clip = MemoryClip(RayCaster(maps.scene), truth, odometry)
    config = RegistrationConfig(alignment=AlignmentConfig(stride_px=9, flow_every_frames=8))
    found = registration.register(clip, NoAgent(40), maps, config, np.random.default_rng(0))
    errors = pose_errors(found.aligned.world_from_camera, truth)
    assert errors.degrees.max() < 1.0, "degrees"
    assert errors.meters.max() < 0.05, "meters; the jump is 0.6 m"


@pytest.mark.slow
def test_mapped_cameras_are_kept_and_confirmed_only_by_pictures(maps):
    """Depth rendered from a camera pose fits the map for any pose, and must not confirm it."""
    truth = walk(40, seed=7)
    clip = MemoryClip(RayCaster(maps.scene), truth, truth, mapped=True)
    found = registration.register(clip, NoAgent(40), maps, RegistrationConfig(), np.random.default_rng(0))
    assert (found.aligned.world_from_camera == truth).all()
    assert np.isnan(found.aligned.median_fit), "no depth was measured"
    assert found.appearance > 0.8
    turned = np.diag([-1.0, 1.0, -1.0, 1.0]) @ truth
    wrong = MemoryClip(RayCaster(maps.scene), truth, turned, mapped=True)
    refused = registration.register(wrong, NoAgent(40), maps, RegistrationConfig(), np.random.default_rng(0))
    assert isinstance(refused, registration.Rejected)


@pytest.mark.slow
def test_other_room_is_rejected(maps):
    truth = walk(40, seed=7)
    other = textured_room(seed=99)
    stretched = Mesh(other.vertices * np.array([1.5, 1.0, 0.8], np.float32), other.faces, other.color)
    clip = MemoryClip(RayCaster(stretched), truth, drifting(truth, 2))
    found = registration.register(clip, NoAgent(40), maps, RegistrationConfig(), np.random.default_rng(0))
    assert isinstance(found, registration.Rejected)
    assert found.reason


def test_symmetric_pose_has_low_confidence(maps):
    """A rotation by 180 degrees about the center of a rectangular room fits depth, but no picture."""
    truth = walk(40, seed=7)
    caster = RayCaster(maps.scene)
    middle = rigid.make(np.eye(3), (maps.scene.vertices.min(0) + maps.scene.vertices.max(0)) / 2)
    turned = middle @ rigid.exp(np.array([0, np.pi, 0, 0, 0, 0])) @ rigid.inverse(middle) @ truth
    clip, config, rng = MemoryClip(caster, truth, truth), ConfidenceConfig(), np.random.default_rng(0)
    certain = np.repeat(1e-8 * np.eye(6)[None], 40, axis=0)
    for poses, low, high in ((truth, 0.8, 1.0), (turned, 0.0, 0.2)):
        scores = score_appearance(clip, NoAgent(40), caster, poses, config, rng)
        appearance = appearance_probability(clip.timestamp_s, scores)
        confidence = camera_confidence(certain, appearance, np.ones(40, bool), rng)
        assert low <= confidence.mean() <= high


def test_pictures_constrain_motion_along_a_wall(maps):
    truth = walk(8)[3]
    clip = MemoryClip(RayCaster(maps.scene), truth[None], None, noise_m=0.0)
    moved = truth @ rigid.exp(np.array([0.01, -0.01, 0.0, 0.03, 0.02, 0.0]))
    correspondences = flow_alignment.flow_correspondences(clip, NoAgent(1), RayCaster(maps.scene), 0, moved)
    before, after = (
        np.median(np.abs(alignment.pose_optimization.residuals(pose[None], correspondences)))
        for pose in (moved, truth)
    )
    assert after < 0.5 * before, "the flow asks for the true pose"


def test_votes_use_only_frames_with_masks(maps):
    truth = walk(12)
    clip = MemoryClip(RayCaster(maps.scene), truth, None)
    hidden = NoAgent(12)
    hidden.__class__ = type(
        "AllAgent", (NoAgent,), {"__getitem__": lambda self, frame: np.full((160, 120), 255, np.uint8)}
    )
    votes = voting.collect(clip, hidden, maps.scene_localizer, VoteConfig(every_frames=4))
    assert len(votes.frame) == 0
    assert votes.nearest is None


@pytest.mark.slow
def test_repainted_room_is_rejected(maps):
    """In dim light too, unless frames were recognized with certainty."""
    truth, caster, rng = walk(40, seed=7), RayCaster(maps.scene), np.random.default_rng(0)
    config = RegistrationConfig(confidence=ConfidenceConfig(decoys=60))
    right = {}
    for name, color in (("other", textured_room(seed=99).color), ("dim", maps.scene.color // 6)):
        clip = MemoryClip(RayCaster(Mesh(maps.scene.vertices, maps.scene.faces, color)), truth, truth)
        scores = score_appearance(clip, NoAgent(40), caster, truth, config.confidence, rng)
        right[name] = appearance_probability(clip.timestamp_s, scores).mean()
    assert right["other"] < 0.5 * config.gate.min_appearance
    assert right["dim"] > 2 * config.gate.min_appearance
    votes = voting.collect(clip, NoAgent(40), maps.scene_localizer, VoteConfig(every_frames=8))
    doubtful, sure = (
        replace(votes, hypotheses=[replace(hypothesis, probability=p) for hypothesis in votes.hypotheses])
        for p in (0.3, 0.9)
    )
    inliers, fit = np.ones(len(votes.frame), bool), np.full(40, 0.9)
    assert "looks different" in registration.rejection_reason(fit, right["other"], doubtful, inliers, config)
    assert registration.rejection_reason(fit, right["dim"], doubtful, inliers, config) is None
    assert registration.rejection_reason(fit, right["other"], sure, inliers, config) is None, (
        "recognized with certainty"
    )
    rare = replace(doubtful, queries=10 * len(votes.frame))
    assert "were recognized and agree" in registration.rejection_reason(
        fit, right["dim"], rare, inliers, config
    ), "chance, of so many"


def test_frames_without_static_depth_are_ignored(maps):
    truth, config = walk(12), RegistrationConfig()
    clip, surface = MemoryClip(RayCaster(maps.scene), truth, None), depth_scans.SurfaceMap(maps.scene)
    seen = [
        depth_scans.scan(clip.depth(frame), clip.depth_intrinsics[frame], stride=9) for frame in range(12)
    ]
    blind = depth_scans.scan(np.zeros(clip.depth_size), clip.depth_intrinsics[0], stride=9)
    votes = voting.collect(clip, NoAgent(12), maps.scene_localizer, VoteConfig(every_frames=2))
    votes, inliers = (
        replace(votes, hypotheses=[replace(one, probability=0.9) for one in votes.hypotheses]),
        np.ones(len(votes.frame), bool),
    )
    gap, fit = depth_scans.measure_fit(surface, [blind] * 8 + seen[8:], truth)
    assert (np.isnan(fit) == np.isnan(gap)).all()
    assert np.isnan(fit).sum() == 8
    assert registration.rejection_reason(fit, 0.9, votes, inliers, config) is None, "the four others fit"
    _, fit = depth_scans.measure_fit(surface, [blind] * 11 + seen[11:], truth)
    assert "only 1 of 12 frames measured" in registration.rejection_reason(fit, 0.9, votes, inliers, config)
    away = rigid.make(np.eye(3), np.array([0.0, 3.0, 0.0])) @ truth
    gap, fit = depth_scans.measure_fit(surface, seen, away)
    assert (fit[np.isnan(gap)] == 0).all(), "depth that meets nothing is no fit"
    assert "5 cm of the room" in registration.rejection_reason(fit, 0.9, votes, inliers, config)


@pytest.mark.filterwarnings("error")
def test_unmeasured_values_are_null(maps):
    truth, nothing = walk(3), np.full(3, np.nan)
    aligned = alignment.AlignedCameras(truth, np.zeros((3, 6, 6)), nothing, nothing)
    found = registration.Registered(
        aligned,
        np.ones(3),
        registration.Roots.unseen(3),
        np.zeros(3),
        voting.no_votes(),
        np.zeros(0, bool),
        1.0,
    )
    figures = pictures.status(found, np.arange(3.0), truth)["figures"]
    assert (figures["depth_gap_m"], figures["depth_fit"]) == (None, None)
    measured = [check for check in pictures.checks(found, mapped=False) if "depth" in check.name]
    assert [check.status for check in measured] == ["warn", "warn"]
    assert not any("depth" in check.name for check in pictures.checks(found, mapped=True))


def test_rejection_names_the_nearest_frame_of_the_walkthrough():
    path = walk(30)
    assert pictures.nearest_frame(path, path[17] @ rigid.exp(np.array([0.02, 0, 0, 0.01, 0, 0]))) == 17


def test_reversed_heading_is_detected():
    ahead = np.tile(np.eye(4), (30, 1, 1))
    ahead[:, 2, 3] = 0.06 * np.arange(30)
    ahead[10] = np.nan
    backwards = ahead @ rigid.exp(np.array([0, np.pi, 0, 0, 0, 0]))
    assert (pictures.head_first(ahead), pictures.head_first(backwards)) == (1.0, 0.0)
    turned = {
        deg: ahead @ rigid.exp(np.array([0, np.radians(deg), 0, 0, 0, 0])) for deg in (-60, -30, 30, 60)
    }
    assert [pictures.head_first(each) for each in turned.values()] == [0.0, 1.0, 1.0, 0.0]
    nosing = ahead @ rigid.exp(np.array([np.radians(60), 0, 0, 0, 0, 0]))
    assert pictures.head_first(nosing) == 1.0, "head down"
    assert pictures.head_first(ahead[:1].repeat(30, axis=0)) is None, "at rest"
