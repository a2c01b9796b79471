"""Uncertain roots that jump away from certain neighbors are dropped and their masks down-weighted."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import torch

from pipeline.data.motion import MotionTable
from pipeline.geometry import rigid
from stages.reconstruct import assemble, rays, results
from stages.reconstruct.body import Pose, prior_terms
from stages.reconstruct.config import LossWeights
from stages.reconstruct.optimize import split_segments
from stages.reconstruct.problem import MAX_PRECISE, prior_precision
from tests.stages.reconstruct.test_optimize import ROOM_M, WIDE, film, problem


def doubted(confidence: np.ndarray, leap_m: float = 2.0) -> assemble.RegisteredVideo:
    """Return a ball that moves 3 cm per frame along x at 2 Hz; uncertain frames are registered too high and
    reversed.
    """
    video = film("v002", len(confidence), True, np.random.default_rng(0), WIDE)
    root = rigid.make(np.eye(3), np.arange(len(confidence))[:, None] * np.array([0.03, 0, 0]))
    root[confidence < 0.4] = root[confidence < 0.4] @ rigid.exp(np.array([0, np.pi, 0, 0, leap_m, 0]))
    return dataclasses.replace(
        video,
        timestamp_s=np.arange(len(confidence)) * 0.5,
        world_from_agent=root,
        agent_confidence=confidence,
    )


def test_jumps_near_certain_roots_are_dropped():
    confidence = np.ones(12)
    confidence[[3, 4, 11]] = 0.1
    root, kept = assemble.replace_outliers(doubted(confidence), 0.6)
    np.testing.assert_allclose(
        root[:11], rigid.make(np.eye(3), np.arange(11)[:, None] * np.array([0.03, 0, 0])), atol=1e-9
    )
    assert np.flatnonzero(~kept).tolist() == [3, 4] and root[11, 1, 3] == 2.0, (
        "nothing certain comes after frame 11"
    )
    assert assemble.replace_outliers(doubted(confidence, 0.2), 0.6)[1].all(), (
        "doubtful, but where the agent may be"
    )
    assert not assemble.replace_outliers(doubted(confidence, 0.2), 0.3)[1][3], "too far for a smaller animal"
    confidence[2:9] = 0.1
    assert assemble.replace_outliers(doubted(confidence), 0.6)[1].all(), "the certain ones are 4 s apart"
    unknown = doubted(np.zeros(4))
    unknown.world_from_agent[:] = np.nan
    assert np.isnan(assemble.replace_outliers(unknown, 0.6)[0]).all()


def test_joined_videos_survive_saving(tmp_path):
    _, videos = problem()
    stores = [video.store for video in videos]
    joined = rays.join(stores, tmp_path, (32, 32))
    starts = (0, len(stores[0].views.intrinsics))
    assert torch.equal(
        joined.agent.frame,
        torch.cat([store.agent.frame + start for store, start in zip(stores, starts, strict=True)]),
    )
    assert torch.equal(joined.scene.feature, stores[0].scene.feature), "the turnaround has no scene"
    depth = joined.views.depth[-1, :32, :24]
    assert torch.equal(depth, stores[1].views.depth[-1]) and not joined.views.depth[-1, :, 24:].any()
    assert not list(tmp_path.iterdir()), "the files have no names"


def test_dropped_frames_are_down_weighted_and_excluded_from_the_joint_phase():
    confidence = np.ones(12)
    confidence[5] = 0.2
    _, videos = problem()
    built, _ = problem(videos=[doubted(confidence), videos[1]])
    assert (
        built.trust[5] == assemble.OUTLIER_MASK_WEIGHT
        and built.trust.sum() == len(built.trust) - 1 + assemble.OUTLIER_MASK_WEIGHT
    )
    runs = built.runs(3)
    assert (
        torch.isin(torch.tensor([0, 2, 6]), runs).all()
        and not torch.isin(torch.tensor([3, 4, 5]), runs).any()
    )


def test_runs_and_segments_end_at_pauses():
    _, videos = problem()
    times = videos[0].timestamp_s + np.where(np.arange(12) >= 7, 3.0, 0.0)
    built, _ = problem(videos=[dataclasses.replace(videos[0], timestamp_s=times), videos[1]])
    starts = built.runs(3)
    assert not torch.isin(torch.tensor([5, 6]), starts).any()
    assert torch.isin(torch.tensor([4, 7]), starts).all()
    segments = [frames.tolist() for frames in split_segments(built, 10)]
    assert segments == [list(range(7)), list(range(7, 12)), list(range(12, 18))]


def test_masks_are_weighted_by_visibility(monkeypatch):
    """Three quarters of the ball are occluded in one frame, nearly all of it in another."""
    built, _ = problem()
    views = built.store.views
    hidden = views.outside_px.clone()
    for frame, keep in ((2, 4), (3, 50)):
        inside = torch.nonzero((hidden[frame] < 0).flatten())[:, 0]
        hidden[frame].view(-1)[inside[len(inside) // keep :]] = 8.0
    monkeypatch.setattr(assemble, "WHOLE_SHARE", 1.0)
    before = assemble.mask_weights(views)
    after = assemble.mask_weights(dataclasses.replace(views, outside_px=hidden))
    assert 0.15 < after[2] / before[2] < 0.35 and after[3] == assemble.MIN_MASK_WEIGHT
    rest = torch.arange(len(before)) > 3
    torch.testing.assert_close(after[rest], before[rest])


def test_the_surface_is_kept_wherever_depth_was_measured():
    """Rays of far walls are sparse; thumbnails measure the walls of the room everywhere, and not the ball."""
    built, _ = problem()
    points = results.measured_points(built)
    outermost = np.abs(points).max(1)
    np.testing.assert_allclose(outermost, ROOM_M, atol=0.1)
    rays_of_scene = built.store.scene.at(torch.nonzero(built.store.scene.depth > 0)[:, 0])
    assert len(points) > 2 * len(rays_of_scene)
    turnaround = torch.nonzero(built.video == 1)[:, 0]
    built.store.views.depth[turnaround] = 9.0
    np.testing.assert_array_equal(results.measured_points(built), points)


def test_roots_are_held_more_firmly_in_recordings_without_depth():
    _, videos = problem()
    mapped = dataclasses.replace(videos[0], clip=SimpleNamespace(mapped=True))
    (before, _), (after, _) = problem(videos=videos), problem(videos=[mapped, videos[1]])
    first = after.video == 0
    assert (before.root_precision == 1).all() and (after.root_precision[~first] == 1).all()
    assert (after.root_precision[first] == assemble.PRECISION_BY_PICTURES).all()
    frame = torch.nonzero(first)[:3, 0]
    moved = Pose.of(after, frame)
    moved.world_from_agent[:, :3, 3] += 0.05
    twist = torch.zeros(3, after.motion.bone.shape[1], 6)
    loose, firm = (prior_terms(each, moved, twist, 3, LossWeights())["root"][1] for each in (before, after))
    torch.testing.assert_close(firm, assemble.PRECISION_BY_PICTURES * loose)


def test_camera_prior_precision_follows_registration_confidence():
    pose = torch.eye(4).repeat(40, 1, 1)
    table = MotionTable(pose, pose, torch.eye(4)[None], [40], [True], knot_frames=10)
    confidence = np.repeat([0.3, 1.0], 20)
    camera_precision = prior_precision(table, confidence)
    assert camera_precision[0] == camera_precision[1] == 1 and camera_precision[4] == MAX_PRECISE
    assert 1 < camera_precision[2] < MAX_PRECISE, "between doubtful and certain frames"
