"""Agent roots: fitting from wrong initial headings, NaN gaps, smoothing."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from pipeline.data.clips import Clip
from pipeline.geometry import rigid
from pipeline.geometry.contact import StandingSurface
from pipeline.geometry.meshes import Mesh, RayCaster, render_view
from pipeline.localization.localizer import PoseHypothesis
from stages.register_videos import agent_fit
from stages.register_videos import agent_roots as roots
from stages.register_videos.agent_tracking import Tracker
from stages.register_videos.config import RootConfig
from tests.stages import room_with_animal

UP = np.array([0.0, 1.0, 0.0])
K = np.array([[236.0, 0, 120], [0, 236.0, 160], [0, 0, 1]])


def animal() -> Mesh:
    """Body, head, tail and legs as boxes; dark front, light back."""
    parts = [
        ((0.14, 0.15, 0.4), (0, 0, 0)),
        ((0.12, 0.13, 0.14), (0, 0.12, 0.24)),
        ((0.03, 0.03, 0.2), (0, 0.06, -0.28)),
    ]
    parts += [((0.05, 0.2, 0.05), (x, -0.12, z)) for x in (-0.05, 0.05) for z in (-0.16, 0.16)]
    boxes = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in parts]
    whole = trimesh.util.concatenate(boxes)
    vertices, faces = trimesh.remesh.subdivide_to_size(whole.vertices, whole.faces, 0.025, max_iter=10)
    shade = np.clip(128 - 250 * vertices[:, 2], 20, 235).astype(np.uint8)
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32), np.repeat(shade[:, None], 3, axis=1))


def observation_of(mesh: Mesh, world_from_agent: np.ndarray, frame: int = 0) -> agent_fit.AgentObservation:
    camera = rigid.look_at(np.array([1.6, 1.2, 0.3]), np.array([0, 0.2, 0.0]), UP)
    depth, hits = render_view(RayCaster(mesh), rigid.inverse(world_from_agent) @ camera, K, 320, 240)
    shade = hits.interpolate(mesh, mesh.color / 255.0)
    seen = np.flatnonzero(depth > 0)[::9]
    ray = np.stack([(seen % 240 + 0.5 - 120) / 236, (seen // 240 + 0.5 - 160) / 236, np.ones(len(seen))], -1)
    noise = np.random.default_rng(0).normal(0, 0.01, len(seen))
    points = rigid.apply(camera, ray * (depth.ravel()[seen] + noise)[:, None])
    return agent_fit.AgentObservation(
        frame, points, shade[seen], depth > 0, np.where(depth > 0, depth, 9.0), camera, K, np.nan, 1.0
    )


@pytest.mark.parametrize("yaw_deg", [0.0, 70.0, 160.0, -100.0])
def test_root_is_found_from_all_initial_headings(yaw_deg):
    mesh = animal()
    model = agent_fit.make_model(mesh, np.random.default_rng(0))
    truth = rigid.make(rigid.rotation_from_vector(UP * np.deg2rad(yaw_deg)), np.array([0.1, 0.22, -0.05]))
    observation = observation_of(mesh, truth)
    placed = agent_fit.fit_coarse(observation, model, agent_fit.initial_poses(observation, model, 12))
    placed = agent_fit.fit_fine(observation, model, placed, rounds=12, tilt=False)
    best = placed[agent_fit.cost(observation, model, placed).argmin()]
    turn = np.rad2deg(rigid.rotation_angle(best[:3, :3], truth[:3, :3]))
    assert turn < 8, "degrees"
    assert np.linalg.norm(best[:3, 3] - truth[:3, 3]) < 0.03, "meters"
    assert best[1, 1] > 1 - 1e-4, "upright"


def moved(poses: np.ndarray, factor: float) -> np.ndarray:
    """Scale the positions of poses."""
    return rigid.make(poses[..., :3, :3], factor * poses[..., :3, 3])


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_fits_scale_with_the_animal(factor):
    """Everything larger, seen from farther away: the same rotations and costs, larger distances."""
    truth = rigid.make(rigid.rotation_from_vector(UP * 0.6), np.array([0.1, 0.22, -0.05]))
    seen = replace(observation_of(animal(), truth), standing_m=0.25)

    def fits(factor: float) -> tuple[np.ndarray, list]:
        mesh = replace(animal(), vertices=factor * animal().vertices)
        model = agent_fit.make_model(mesh, np.random.default_rng(0))
        points, depth = factor * seen.points_world, factor * seen.depth
        camera, standing_m = moved(seen.world_from_camera, factor), factor * seen.standing_m
        observation = replace(
            seen, points_world=points, depth=depth, world_from_camera=camera, standing_m=standing_m
        )
        start = agent_fit.initial_poses(observation, model, 12)
        coarse = agent_fit.fit_coarse(observation, model, start)
        fine = agent_fit.fit_fine(observation, model, coarse, rounds=4, tilt=True)
        prior = agent_fit.PosePrior(coarse[0], (0.1, 0.05 * factor))
        near = agent_fit.fit_near(observation, model, prior, rounds=4)
        cost, share = agent_fit.cost(observation, model, fine), np.ones(12)
        smooth = roots.smooth(0.1 * np.arange(12), fine, cost, share, 0.15, model.length_m)
        poses = [start, coarse, fine, smooth, near.world_from_agent[None]]
        costs = [*agent_fit.cost(observation, model, start), *cost, near.total]
        return np.concatenate([moved(each, 1 / factor) for each in poses]), costs

    (poses, costs), (others, other_costs) = fits(1.0), fits(factor)
    np.testing.assert_allclose(others, poses, atol=1e-3)
    np.testing.assert_allclose(other_costs, costs, atol=1e-4)


def test_tilt_is_estimated_if_enabled():
    mesh = animal()
    model = agent_fit.make_model(mesh, np.random.default_rng(0))
    truth = rigid.make(
        rigid.rotation_from_vector(UP * 1.2) @ rigid.rotation_from_vector(np.array([-0.35, 0, 0])),
        np.array([0, 0.25, 0]),
    )
    start = rigid.make(rigid.rotation_from_vector(UP * 1.2), np.array([0.02, 0.23, 0]))
    placed = agent_fit.fit_fine(observation_of(mesh, truth), model, start[None], rounds=12, tilt=True)[0]
    assert np.rad2deg(rigid.rotation_angle(placed[:3, :3], truth[:3, :3])) < 10, "degrees, of 20"


def test_smoothing_keeps_gaps_and_reduces_noise():
    rng, time = np.random.default_rng(0), np.arange(50) * 0.1
    truth = rigid.make(
        rigid.rotation_from_vector(0.5 * time[:, None] * UP),
        np.stack([0.4 * time, 0 * time + 0.2, 0 * time], -1),
    )
    noisy = truth @ rigid.exp(rng.normal(0, 1, (50, 6)) * ([0.08] * 3 + [0.02] * 3))
    cost, share = np.full(50, 0.03), np.ones(50)
    noisy[20:25], cost[20:25] = np.nan, np.nan
    smooth = roots.smooth(time, noisy, cost, share, 0.15, 0.6)
    assert np.isnan(smooth[20:25]).all()
    known = np.isfinite(cost)
    before, after = (
        np.linalg.norm(poses[known, :3, 3] - truth[known, :3, 3], axis=1).mean() for poses in (noisy, smooth)
    )
    assert after < 0.7 * before


def test_lying_animal_is_not_lifted_to_standing_height():
    mesh = animal()
    model = agent_fit.make_model(mesh, np.random.default_rng(0))
    truth = rigid.make(rigid.rotation_from_vector(UP * 0.6), np.array([0.1, 0.22, -0.05]))
    observation = replace(observation_of(mesh, truth), standing_m=0.22 + 0.12)
    start = rigid.make(truth[:3, :3], truth[:3, 3] + [0.02, 0.1, 0.02])
    placed = agent_fit.fit_fine(observation, model, start[None], rounds=12, tilt=True)[0]
    assert np.linalg.norm(placed[:3, 3] - truth[:3, 3]) < 0.03, "meters"


def partly(
    observation: agent_fit.AgentObservation, agent_from_world: np.ndarray
) -> agent_fit.AgentObservation:
    """Keep only the hind part of the animal."""
    hind = rigid.apply(agent_from_world, observation.points_world)[:, 2] < -0.12
    return replace(
        observation, points_world=observation.points_world[hind], color=observation.color[hind], share=0.1
    )


def test_partial_views_are_tracked_or_left_without_root():
    """Ten frames of a turn; four show only the hind part, and two more do after two seconds."""
    mesh, time = animal(), np.append(np.arange(10) * 0.1, [3.0, 3.1])
    model = agent_fit.make_model(mesh, np.random.default_rng(0))
    truth = rigid.make(
        rigid.rotation_from_vector(0.8 * time[:, None] * UP),
        np.stack([0.2 * time, 0.22 + 0 * time, 0 * time], -1),
    )
    little = np.isin(np.arange(12), [4, 5, 6, 7, 10, 11])
    shown = [observation_of(mesh, pose, frame) for frame, pose in enumerate(truth)]
    shown = [
        partly(each, rigid.inverse(pose)) if few else each
        for each, pose, few in zip(shown, truth, little, strict=True)
    ]
    alone = truth.copy()
    alone[little] = alone[little] @ rigid.make(rigid.rotation_from_vector(UP * np.pi), np.array([0, 0, -0.4]))
    cost = np.array([agent_fit.cost(o, model, pose[None])[0] for o, pose in zip(shown, alone, strict=True)])
    share = np.where(little, 0.1, 0.6)
    tracker = Tracker(time, alone, cost, share, lambda frame: shown[frame], model)
    world_from_agent, cost_m = tracker.track()
    assert np.isnan(cost_m[10:]).all() and np.isnan(world_from_agent[10:]).all()
    off = np.linalg.norm(world_from_agent[:10, :3, 3] - truth[:10, :3, 3], axis=1)
    turn = np.rad2deg(rigid.rotation_angle(world_from_agent[:10, :3, :3], truth[:10, :3, :3]))
    assert off.max() < 0.08 and turn.max() < 30


def test_localizer_poses_are_the_roots_as_they_are(tmp_path):
    """Turned and shifted poses, which fitting would correct; one frame without a pose."""
    cameras, agents = (poses[:4] for poses in room_with_animal.session())
    seen = room_with_animal.record(tmp_path / "frames", cameras, agents, cameras).masks
    masks = type("Masks", (list,), {"visible": seen.any((1, 2))})(255 * seen.astype(np.uint8))
    predicted = agents @ rigid.exp(np.array([0.2, 0.8, 0.0, 0.1, 0.05, 0.0]))
    answers = [
        [PoseHypothesis(rigid.inverse(root) @ camera, 0.5, 0.5, UP[None], UP[None]) for root in roots]
        for camera, *roots in zip(cameras, predicted, agents, strict=True)
    ]
    answers[2] = []
    localizer = SimpleNamespace(localize=lambda *_: answers.pop(0))
    standing = StandingSurface(RayCaster(animal()), 0.0)
    config, rng = RootConfig(initialization="localizer"), np.random.default_rng(0)
    clip = Clip.open(tmp_path / "frames")
    found = roots.find_roots(clip, masks, animal(), standing, localizer, cameras, config, rng)
    assert found.visible.tolist() == [True, True, False, True] and not answers
    placed = found.world_from_agent[found.visible]
    np.testing.assert_allclose(placed, predicted[found.visible], atol=1e-9)
    assert (found.share[found.visible] > 0).all() and np.isfinite(found.cost[found.visible]).all()
